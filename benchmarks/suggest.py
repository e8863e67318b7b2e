"""How many guesses of `fleet-slip mapping suggest` are right, on files of every format.

python -m benchmarks.suggest
"""

from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory


def main() -> None:
    """Print a table: of each log how many signals it has, and which were not guessed right."""
    from tests.support.suggested import LOGS, suggest, wrong_guesses  # noqa: PLC0415 - of the tests

    print("| log | signals | right: column, unit and sign | not right | other guesses |")
    print("| --- | --- | --- | --- | --- |")
    right = whole = 0
    for name, one in LOGS.items():
        with TemporaryDirectory() as folder:
            draft = suggest(one, Path(folder))
        wrong = wrong_guesses(one, draft)
        others = [guess for guess in draft.guesses if guess not in one.names]
        right += len(one.names) - len(wrong)
        whole += len(one.names)
        cells = (name, len(one.names), len(one.names) - len(wrong), ", ".join(wrong) or "none")
        print("|", " | ".join(map(str, cells)), "|", ", ".join(others) or "none", "|", flush=True)
    print(f"| all | {whole} | {right} | | |")
    _judge_strangers()


def _judge_strangers() -> None:
    """Print how many lines are right of logs with names that departments publish, by half."""
    from tests.support.strangers import score, strangers  # noqa: PLC0415 - of the tests

    found: dict[str, Counter[str]] = {"build": Counter(), "judge": Counter()}
    for columns in strangers().values():
        with TemporaryDirectory() as folder:
            found[columns[0].half] += score(columns, Path(folder))
    kinds = ("right", "asked", "wrong", "missing", "extra")
    print("\n| half |", " | ".join(kinds), "|")
    for half, counts in found.items():
        print("|", " | ".join([half, *(str(counts[kind]) for kind in kinds)]), "|", flush=True)


if __name__ == "__main__":
    main()
