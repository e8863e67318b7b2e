"""Pages as readers meet them: by keyboard and screen reader, on a phone, and on paper."""

import json
import re
import shutil
import subprocess
from datetime import date
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest
from pypdfium2 import PdfDocument

import fleet_slip
from fleet_slip.evaluation.watch import drive_frames, render_watch
from fleet_slip.operations.night import render_night
from tests.support.landing import Landing
from tests.support.reported import Reported

CHROMIUM = (
    *("chromium", "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"),
    *("--no-first-run", "--disable-background-networking", "--host-resolver-rules=MAP * ~NOTFOUND"),
)
RULES = ("wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice")
DARK = "--blink-settings=preferredColorScheme=0"
NARROW_PX = 400
LEAST_FULL = 0.6
"""Share of a printed page down to its last mark, of all pages but the last."""

pytestmark = pytest.mark.tools("chromium")


@pytest.fixture(scope="module")
def pages(
    reported: Reported, smoke_root: Path, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """The report, the summary of a night, and a drive that plays."""
    folder = tmp_path_factory.mktemp("pages")
    landing = Landing(folder / "landing", smoke_root)
    landing.prepare()
    landing.land("first", landing.drives()[:4], date(2026, 10, 5), yaw_rate_rad_s="0.01")
    night = fleet_slip.open(folder / "data").nightly(
        landing.folder, str(landing.mapping), "fleet", models="table1"
    )
    fleet = fleet_slip.open(smoke_root)
    frames = drive_frames(fleet.warehouse, "smoke-2024-05-01-0000", fleet.model("smoke"))
    made = {"night": render_night(night), "watch": render_watch(frames)}
    for name, text in made.items():
        (folder / f"{name}.html").write_text(text, encoding="utf-8")
    return {"report": reported.page, **{name: folder / f"{name}.html" for name in made}}


def browse(page: Path, folder: Path, *flags: str) -> str:
    command = [*CHROMIUM, f"--user-data-dir={folder / 'profile'}", *flags, page.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=300).stdout


def asked(page: Path, folder: Path, script: str, *flags: str) -> Any:
    """Return what a script that sets `answer` comes to on a page, without the page's policy."""
    text = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page.read_text("utf-8"))
    told = (
        "const p = document.createElement('pre'); p.id = 'answer'; "
        "p.textContent = encodeURIComponent(JSON.stringify(answer)); document.body.append(p);"
    )
    asking = folder / "asking.html"
    asking.write_text(
        text.replace("</body>", f"{script.replace('TELL', told)}</body>"), encoding="utf-8"
    )
    shown = browse(asking, folder, "--virtual-time-budget=60000", "--dump-dom", *flags)
    found = re.search(r'<pre id="answer">(.*?)</pre>', shown, re.DOTALL)
    assert found, shown[-2000:]
    return json.loads(unquote(found[1]))


@pytest.mark.tools("axe.min.js")
@pytest.mark.parametrize("flags", [("--window-size=1200,1000",), ("--window-size=500,900", DARK)])
@pytest.mark.parametrize("name", ["report", "night", "watch"])
def test_axe_has_no_complaint(
    pages: dict[str, Path], name: str, flags: tuple[str, ...], tmp_path: Path
) -> None:
    shutil.copy(str(shutil.which("axe.min.js")), tmp_path / "axe.js")
    script = (
        '<script src="axe.js"></script><script>'
        f"axe.run(document, {{runOnly: {json.dumps(RULES)}}}).then(r => {{ const answer = "
        "{broken: r.violations.map(v => [v.id, v.nodes.length, v.nodes[0].html]), "
        "passed: r.passes.length}; TELL });</script>"
    )
    found = asked(pages[name], tmp_path, script, *flags)
    assert found["broken"] == []
    assert found["passed"] > 20


@pytest.mark.parametrize("name", ["report", "night", "watch"])
def test_a_narrow_screen_need_not_be_scrolled_across(
    pages: dict[str, Path], name: str, tmp_path: Path
) -> None:
    frame = tmp_path / "frame.html"
    shutil.copy(pages[name], tmp_path / "page.html")
    frame.write_text(
        f'<body><iframe id="f" src="page.html" width="{NARROW_PX}" height="900"></iframe></body>'
    )
    script = (
        "<script>document.getElementById('f').onload = () => { const d = "
        "document.getElementById('f').contentDocument.documentElement; "
        "const answer = [d.scrollWidth, d.clientWidth]; TELL }</script>"
    )
    wide, seen = asked(frame, tmp_path, script, "--allow-file-access-from-files")
    assert wide <= seen


@pytest.mark.parametrize("name", ["report", "night"])
def test_paper_has_no_half_empty_pages(pages: dict[str, Path], name: str, tmp_path: Path) -> None:
    file = tmp_path / "page.pdf"
    browse(pages[name], tmp_path, "--no-pdf-header-footer", f"--print-to-pdf={file}")
    document = PdfDocument(file)
    filled = []
    for sheet in document:
        marks = np.asarray(sheet.render(scale=0.5).to_pil().convert("L")) < 250
        filled.append(float(np.flatnonzero(marks.any(axis=1)).max() / len(marks)))
    assert all(share > LEAST_FULL for share in filled[:-1]), filled
