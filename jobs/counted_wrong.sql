-- The first invalid Gram row from a car, and the reason; `find_impossible` checks sums and products.
-- `counted` contains the rows, numbered from 1; `known` contains the feature sets that cars can compute.
WITH named AS (
    SELECT *, CASE WHEN signals = '' THEN [] ELSE string_split(signals, ',') END AS names
    FROM counted
),

checked AS (
    SELECT
        number,
        drive_id,
        CASE
            WHEN source IS DISTINCT FROM 'received' THEN 'does not have the source ''received'''
            WHEN coalesce(trim(vehicle_id), '') = '' THEN 'has no vehicle_id'
            WHEN coalesce(trim(drive_id), '') = '' THEN 'has no drive_id'
            WHEN known.columns IS NULL THEN 'has a feature set or signals that are defined differently here'
            WHEN signals IS NULL OR names <> list_filter(known.columns, lambda name: list_contains(names, name))
                THEN 'has signals that its feature set lacks, or another order of signals'
            WHEN (len(sums), len(products)) IS DISTINCT FROM (len(names), len(names) * (len(names) + 1) // 2)
                THEN 'does not have one sum a signal and one product a pair of signals'
            WHEN list_aggregate(sums, 'count') < len(sums) OR list_aggregate(products, 'count') < len(products)
                THEN 'has a sum or product that is null'
            WHEN coalesce(n, 0) < 1 THEN 'has no rows'
            WHEN NOT list_contains(known.parts, coalesce(part, '')) THEN 'has a block that its feature set lacks'
            WHEN in_time <> (course_late IS NOT NULL) OR NOT coalesce(course_late, 0) BETWEEN $earliest AND $latest
                THEN 'has a course delay that is missing, unexpected or out of range'
            WHEN day IS NULL OR NOT day BETWEEN DATE '2000-01-01' AND current_date + 1
                THEN 'has a day before 2000 or in the future'
            WHEN (vehicle_id, day) <> first_value((vehicle_id, day)) OVER (PARTITION BY drive_id ORDER BY number)
                THEN 'has another car or day than an earlier row of its drive'
            WHEN row_number() OVER (PARTITION BY drive_id, feature_set, part, signals ORDER BY number) > 1
                THEN 'appears twice'
            WHEN sum(n) OVER (PARTITION BY vehicle_id, day, feature_set, part ORDER BY number) > $longest
                THEN 'exceeds 24 hours of driving of its car on a day'
        END AS reason
    FROM named
    LEFT JOIN known ON feature_set = key
)

SELECT number, drive_id, reason
FROM checked
WHERE reason IS NOT NULL
ORDER BY number
LIMIT 1
