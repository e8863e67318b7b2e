-- Pieces of a cohort's days, of $piece drives or a quarter more, with hashes that change with any of their Gram rows.
-- New days change the last piece alone. The predicate may use any column of the view "drives".
WITH days AS (
    SELECT
        day,
        count(DISTINCT drive_id) FILTER (WHERE feature_set = 'signals') AS drives,
        bit_xor(hash(feature_set, drive_id, file, block, signals, row_count)) AS rows
    FROM grams
    WHERE signals <> '' AND (
        {predicate}
    )
    GROUP BY day
),

numbered AS (
    SELECT
        *,
        (sum(drives) OVER (ORDER BY day) - drives) // $piece AS number,
        greatest((sum(drives) OVER () + 3 * $piece // 4) // $piece, 1) - 1 AS last_number
    FROM days
    WHERE drives > 0
)

SELECT
    min(day) AS first_day,
    max(day) AS last_day,
    list(rows ORDER BY day) AS rows
FROM numbered
GROUP BY least(number, last_number)
ORDER BY first_day
