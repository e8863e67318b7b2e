"""An estimator from the JSON document alone, by docs/export.md; it knows nothing of the package."""

from typing import Any


def nearest(value: int, divisor: int) -> int:
    size = (2 * abs(value) + divisor) // (2 * divisor)
    return -size if value < 0 else size


def clip(value: int, limit: int) -> int:
    return max(-limit, min(limit, value))


def divide(a: int, b: int) -> int:
    return abs(a) // b if a >= 0 else -(abs(a) // b)


DO: dict[str, Any] = {
    "+": int.__add__, "-": int.__sub__, "*": int.__mul__, "//": divide, "abs": int.__abs__,
    "negative": int.__neg__, "sign": lambda a: (a > 0) - (a < 0),
}  # fmt: skip


def source(one: Any, counts: dict[str, int | None]) -> int | None:
    found: list[Any] = []
    for word, *rest in one["steps"]:
        known = [found[i] for i in rest] if word in DO else rest
        if (word == "signal" and counts[rest[0]] is None) or (word == "//" and known[1] <= 0):
            return None
        found.append(
            DO[word](*known) if word in DO else counts[rest[0]] if word == "signal" else rest[0]
        )
    if "guard" in one and found[one["guard"]["step"]] < one["guard"]["at_least"]:
        return None
    return clip(found[-1], one["limit"])


def window(one: Any, values: list[Any], sums: list[int], counts: list[int]) -> int | None:
    kind, back = one["kind"], one.get("ticks") or len(values)
    first = max(len(values) - back, 0)
    now = values[-1]
    total, count = sums[-1] - sums[first], counts[-1] - counts[first]
    if kind == "lag":
        now = values[-1 - back] if len(values) > back else None
    if now is None:
        return None
    if kind in ("value", "lag", "sum"):
        total, count = total if kind == "sum" else now, 1
    quotient = nearest(total * one["numerator"], one["denominator"] * count)
    return clip(quotient, one["limit"])


def factor(one: Any, of: int, fact: int) -> int:
    return clip(
        nearest(of * (fact - one["less"]) * one["numerator"], one["denominator"]), one["limit"]
    )


def gate(one: Any, of: int, at: int) -> int:
    low, peak, high, full = one["low"], one["peak"], one["high"], one["weight"]
    rising = 0 if at <= low else (at - low) * full // (peak - low)
    falling = (
        full if high is None else full - (at - peak) * full // (high - peak) if at < high else 0
    )
    return nearest(of * (rising if at < peak else falling), full)


def angles(
    program: Any, facts: list[Any], numbers: list[Any], samples: list[Any]
) -> list[int | None]:
    angle = program["angle"]
    out: list[int | None] = []
    past: list[Any] = [([], [0], [0]) for _ in program["sources"]]
    for sample in samples:
        valid = {s["name"]: c if c is not None and s["min"] <= c <= s["max"] else None
                 for s, c in zip(program["signals"], sample, strict=True)}  # fmt: skip
        for one, (values, sums, counts) in zip(program["sources"], past, strict=True):
            values.append(source(one, valid))
            sums.append(sums[-1] + (values[-1] or 0))
            counts.append(counts[-1] + (values[-1] is not None))
        found: list[Any] = []
        for one in program["columns"]:
            kind, of = one["kind"], found[one["of"]] if "of" in one else None
            if kind == "number":
                known, running = numbers[one["number"]], one["running"]
                by = (
                    known - one["less"]
                    if known is not None
                    else 0
                    if running is None
                    else found[running]
                )
                found.append(None if of is None or by is None else by if one["alone"] else of * by)
            elif kind in ("factor", "gate"):
                by = facts[one["fact"]] if kind == "factor" else found[one["by"]]
                found.append(
                    None
                    if of is None or by is None
                    else (factor if kind == "factor" else gate)(one, of, by)
                )
            else:
                found.append(window(one, *past[one["source"]]))
        terms = [(found[t["column"]], int(t["coefficient"])) for t in angle["terms"]]
        if any(n is None for n, _ in terms):
            out.append(None)
        else:
            total = int(angle["intercept"]) + sum(n * c for n, c in terms)
            nearest_up = (2 * total + 2 ** angle["bits"]) >> (angle["bits"] + 1)
            out.append(clip(nearest_up, angle["limit"]))
    return out
