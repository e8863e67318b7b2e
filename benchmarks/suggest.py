"""How many guesses of `fleet-slip mapping suggest` are right, on files of every format.

python -m benchmarks.suggest
"""

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


if __name__ == "__main__":
    main()
