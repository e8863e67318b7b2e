-- Rows of a cohort that have the label, by the campaign that made them; null for measured drives.
SELECT
    source,
    campaign,
    sum(n)::BIGINT AS n
FROM grams
WHERE feature_set = '{feature_set}' AND list_contains(string_split(signals, ','), '{label}') AND (
    {predicate}
)
GROUP BY source, campaign
ORDER BY source, campaign
