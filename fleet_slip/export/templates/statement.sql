-- ${version.reference}: ${angle.column}, exported by fleet-slip. Do not edit.
-- SHA-256 of the version: ${version.sha256}
-- Trained on ${trained.drives} drives, SHA-256 ${trained.drives_sha256 or "unknown"}
-- angle: counts of ${angle.scale|decimal} ${angle.unit}, within ${"%.12f"|format(angle.error|float)} counts of the exact model
//% if macro
CREATE OR REPLACE MACRO ${macro}(source) AS TABLE
//% endif
//% for columns in layers
${"WITH " if loop.first}layer_${loop.index0} AS (
    SELECT
        ${((["drive_id", "tick"] if loop.first else ["*"]) + columns)|join(",\n        ")}
    FROM ${rows if loop.first else "layer_%s"|format(loop.index0 - 1)}
),
${""}
//% endfor
rounded AS (
    SELECT drive_id, tick, ${rounded} AS angle
    FROM layer_${layers|length - 1}
)

SELECT
    drive_id,
    tick,
    angle,
    CAST(angle AS DOUBLE PRECISION) * ${angle.scale|decimal} AS ${angle.column}
FROM rounded${";" if macro}
