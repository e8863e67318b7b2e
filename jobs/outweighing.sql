-- The received Gram rows of some cars beyond so many rows of each: its logs and its short drives count first.
SELECT vehicle_id, n, drive_id
FROM grams
WHERE feature_set = '{feature_set}' AND signals <> '' AND vehicle_id IN ({cars}) AND (
    {condition}
)
QUALIFY
    source = 'received'
    AND sum(n) OVER (PARTITION BY vehicle_id ORDER BY source = 'received', n, drive_id) > {most}
ORDER BY vehicle_id, n, drive_id
