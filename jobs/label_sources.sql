-- Number of rows of a cohort with the label, by source and campaign.
SELECT
    source,
    campaign,
    sum(row_count)::BIGINT AS n
FROM grams
WHERE feature_set = '{feature_set}' AND list_contains(string_split(signals, ','), '{label}') AND (
    {predicate}
)
GROUP BY source, campaign
ORDER BY source, campaign
