-- The first invalid Gram row from a car, and the reason; `find_impossible` checks sums and products.
-- `counted` contains the rows, numbered from 1; `known` contains the feature sets that cars can compute.
WITH named AS (
    SELECT *, CASE WHEN signals = '' THEN [] ELSE string_split(signals, ',') END AS names
    FROM counted
),

judged AS (
    SELECT
        number,
        drive_id,
        CASE
            WHEN source IS DISTINCT FROM 'received' THEN 'has another source than ''received'''
            WHEN coalesce(trim(vehicle_id), '') = '' THEN 'has no name of a car'
            WHEN coalesce(trim(drive_id), '') = '' THEN 'has no name of a drive'
            WHEN known.columns IS NULL THEN 'is of a feature set, or of signals, that mean something else here'
            WHEN signals IS NULL OR names <> list_filter(known.columns, lambda name: list_contains(names, name))
                THEN 'has signals that its set has not, or in another order'
            WHEN (len(sums), len(products)) IS DISTINCT FROM (len(names), len(names) * (len(names) + 1) // 2)
                THEN 'has not the sums and products of its signals'
            WHEN list_aggregate(sums, 'count') < len(sums) OR list_aggregate(products, 'count') < len(products)
                THEN 'has a sum or a product that is null'
            WHEN coalesce(n, 0) < 1 THEN 'has no rows'
            WHEN NOT list_contains(known.parts, coalesce(part, '')) THEN 'has a part that its set has not'
            WHEN in_time <> (course_late IS NOT NULL) OR NOT coalesce(course_late, 0) BETWEEN $earliest AND $latest
                THEN 'is corrected by a delay that no course has'
            WHEN day IS NULL OR NOT day BETWEEN DATE '2000-01-01' AND current_date + 1
                THEN 'is of a day before 2000 or in the future'
            WHEN (vehicle_id, day) <> first_value((vehicle_id, day)) OVER (PARTITION BY drive_id ORDER BY number)
                THEN 'is of another car or day than a row of its drive before'
            WHEN row_number() OVER (PARTITION BY drive_id, feature_set, part, signals ORDER BY number) > 1
                THEN 'is there twice'
            WHEN sum(n) OVER (PARTITION BY vehicle_id, day, feature_set, part ORDER BY number) > $longest
                THEN 'makes its car drive more than 24 hours on a day'
        END AS reason
    FROM named
    LEFT JOIN known ON feature_set = key
)

SELECT number, drive_id, reason
FROM judged
WHERE reason IS NOT NULL
ORDER BY number
LIMIT 1
