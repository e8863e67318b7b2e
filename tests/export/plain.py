"""An estimator from the JSON document alone, by docs/export.md; it knows nothing of the package."""

from operator import add, mul, neg, sub
from typing import Any


def divide(a: int, b: int) -> int | None:
    return None if b <= 0 else a // b if a >= 0 else -(-a // b)


def power(a: int, bound: int) -> int:
    return 1 << next(n for n in range(99) if a <= bound << n)


def nearest(a: int, b: int) -> int | None:
    return divide(2 * a + (b if a >= 0 else -b), 2 * b)


DO: dict[str, Any] = {
    "+": add, "-": sub, "*": mul, "//": divide, "nearest": nearest, "min": min, "max": max,
    "negative": neg, "abs": abs, "power": power, "sign": lambda a: (a > 0) - (a < 0),
    "clip": lambda a, b: max(-b, min(a, b)), "where": lambda a, _: a,
    "at_least": lambda a, b: a if a >= b else None,
}  # fmt: skip


def angles(program: Any, facts: Any, numbers: Any, samples: Any) -> list[int | None]:
    angle, past, out = program["angle"], list[Any](), list[int | None]()
    sums: Any = [[0, 0] for _ in program["steps"]]
    states: Any = {step: 0 for step, (do, *_) in enumerate(program["steps"]) if do == "state"}
    for sample in samples:
        signals = [n if n is not None and s["min"] <= n <= s["max"] else None
                   for n, s in zip(sample, program["signals"], strict=True)]  # fmt: skip
        inputs = {"signal": signals, "fact": facts, "number": numbers}
        now: list[Any] = []
        following = dict(states)
        past.append(now)
        for (do, *operands), total in zip(program["steps"], sums, strict=True):
            if do in DO:
                values = [now[i] for i in operands]
                now.append(None if None in values else DO[do](*values))
            elif do in ("constant", *inputs):
                now.append(operands[0] if do == "constant" else inputs[do][operands[0]])
            elif do == "state":
                now.append(states[len(now)])
            elif do == "next":
                following[operands[1]] = now[operands[0]]
                now.append(now[operands[0]])
            elif do == "shift":
                now.append(
                    None
                    if now[operands[0]] is None
                    else nearest(now[operands[0]], 1 << operands[1])
                )
            elif do == "else":
                now.append(now[operands[0]] if now[operands[0]] is not None else now[operands[1]])
            else:
                new, old = (
                    now[operands[0]],
                    past[-1 - operands[1]][operands[0]] if len(past) > operands[1] else None,
                )
                if old is not None and operands[1]:
                    total[:] = total[0] - old, total[1] - 1
                if new is not None and do != "ago" and total[1] < operands[2]:
                    total[:] = total[0] + new, total[1] + 1
                now.append(old if do == "ago" else total[do == "values"])
        states = following
        terms = [(now[t["step"]], int(t["coefficient"])) for t in angle["terms"]]
        if any(n is None for n, _ in terms):
            out.append(None)
            continue
        total = int(angle["intercept"]) + sum(n * c for n, c in terms)
        rounded = (2 * total + 2 ** angle["bits"]) >> (angle["bits"] + 1)
        out.append(DO["clip"](rounded, angle["limit"]))
    return out
