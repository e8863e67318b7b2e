"""Writes docs/measured.md from the records of figures in benchmarks/figures/*.json.

    python -m benchmarks.measured_page              write the page, and list old figures
    python -m benchmarks.measured_page --check      list them only
    python -m benchmarks.measured_page --measured BEGINNING ...   first date figures by today

A figure that was measured again is changed in its file by hand; `--measured` then records commit,
date, machine and the checksum of its code.
"""

import argparse
import datetime
import json

from tests.support.bench_record import commit
from tests.support.measured_page import PAGE, digest_code, is_stale, load_sections, write_page

MACHINE = "2 cores, AMD EPYC, 24 GiB, Python 3.11"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--measured", nargs="*", default=[], help="beginnings of figures")
    options = parser.parse_args()
    sections = load_sections()
    for file, content in sections.items():
        for figure in content["figures"]:
            if any(figure["figure"].startswith(name) for name in options.measured):
                today = datetime.datetime.now(datetime.UTC).date()
                figure |= {"commit": commit().rstrip("+"), "date": f"{today}", "machine": MACHINE}
                figure["code_sha256"] = digest_code(figure["code"])
                text = json.dumps(content, indent=1, ensure_ascii=False)
                file.write_text(text + "\n", encoding="utf-8")
    figures = [figure for content in sections.values() for figure in content["figures"]]
    stale = [figure for figure in figures if is_stale(figure)]
    print(f"{len(figures)} figures, {len(stale)} older than the code")
    for figure in stale:
        print(f"  {figure['date']}  {figure['figure']}: {figure['command']}")
    if not options.check:
        PAGE.write_text(write_page(sections), encoding="utf-8")


if __name__ == "__main__":
    main()
