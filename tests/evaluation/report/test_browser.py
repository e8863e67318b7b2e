"""Pages as a browser shows them: by keyboard and screen reader, on a phone, and on paper."""

import json
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import fleet_slip
from fleet_slip.evaluation.watch import drive_frames, render_watch
from fleet_slip.pages.page import PALETTE
from tests.support.reported import Reported

CHROMIUM = (
    *("chromium", "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"),
    *("--no-first-run", "--disable-background-networking", "--disable-component-update"),
    *("--disable-sync", "--hide-scrollbars", "--enable-logging=stderr"),
    "--host-resolver-rules=MAP * ~NOTFOUND",
)
RULES = ("wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice")
DARK = "--blink-settings=preferredColorScheme=0"
NARROW_PX = 400
DESK_PX = 1200
LONG_PX = 16000

pytestmark = pytest.mark.tools("chromium")


@pytest.fixture(scope="module")
def pages(
    reported: Reported, smoke_root: Path, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """The report, and a drive that plays."""
    fleet = fleet_slip.open(smoke_root)
    frames = drive_frames(fleet.warehouse, "smoke-2024-05-01-0000", fleet.models.get("smoke"))
    file = tmp_path_factory.mktemp("pages") / "watch.html"
    file.write_text(render_watch(frames), encoding="utf-8")
    return {"report": reported.page, "watch": file}


def browse(page: Path, folder: Path, *flags: str) -> subprocess.CompletedProcess[str]:
    command = [*CHROMIUM, f"--user-data-dir={folder / 'profile'}", *flags, page.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)


def evaluate_script(page: Path, folder: Path, script: str, *flags: str) -> Any:
    """Return what a script that sets `answer` comes to on a page, without the page's policy."""
    text = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page.read_text("utf-8"))
    command = (
        "const p = document.createElement('pre'); p.id = 'answer'; "
        "p.textContent = encodeURIComponent(JSON.stringify(answer)); document.body.append(p);"
    )
    asking = folder / "asking.html"
    asking.write_text(
        text.replace("</body>", f"{script.replace('TELL', command)}</body>"), encoding="utf-8"
    )
    shown = browse(asking, folder, "--virtual-time-budget=60000", "--dump-dom", *flags).stdout
    match = re.search(r'<pre id="answer">(.*?)</pre>', shown, re.DOTALL)
    assert match, shown[-2000:]
    return json.loads(unquote(match[1]))


@pytest.mark.tools("axe.min.js")
@pytest.mark.parametrize("flags", [("--window-size=1200,1000",), ("--window-size=500,900", DARK)])
@pytest.mark.parametrize("name", ["report", "watch"])
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
    report = evaluate_script(pages[name], tmp_path, script, *flags)
    assert report["broken"] == []
    assert report["passed"] > 20


@pytest.mark.parametrize("name", ["report", "watch"])
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
    wide, seen = evaluate_script(frame, tmp_path, script, "--allow-file-access-from-files")
    assert wide <= seen


@dataclass(frozen=True)
class Shown:
    """The output of a browser: a picture of shape (height, width, 3), and its console."""

    picture: NDArray[np.uint8]
    console: list[str]

    def pixels(self, name: str, *, dark: bool = False) -> int:
        tone = PALETTE[name]
        colour = [int((tone.dark if dark else tone.light)[i : i + 2], 16) for i in (1, 3, 5)]
        return int((self.picture == colour).all(axis=2).sum())


def show(
    page: Path, folder: Path, *flags: str, width: int = DESK_PX, height: int = LONG_PX
) -> Shown:
    shot = folder / "shot.png"
    flags = (f"--window-size={width},{height}", f"--screenshot={shot}", *flags)
    done = browse(page, folder, *flags)
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return Shown(np.asarray(Image.open(shot).convert("RGB")), console)


def test_the_page_shows_its_figures_without_a_complaint(reported: Reported, tmp_path: Path) -> None:
    """The page's own policy forbids every request, so that an attempt would be on the console."""
    shown = show(reported.page, tmp_path)
    assert shown.console == []
    assert tuple(shown.picture[0, 0]) == (255, 255, 255)
    for line in ("truth", "model_1", "model_2", "model_3", "model_4", "model_5", "kalman"):
        assert shown.pixels(line) > 300, line
    assert shown.pixels("unstable") > 20


def test_a_request_to_outside_would_be_seen(reported: Reported, tmp_path: Path) -> None:
    text = reported.page.read_text(encoding="utf-8")
    asking = tmp_path / "asking.html"
    asking.write_text(text.replace("</h1>", '</h1><img src="https://example.org/a.png" alt="">'))
    (complaint,) = show(asking, tmp_path, height=600).console
    assert "example.org" in complaint


def test_the_page_is_dark_for_those_who_prefer_it(reported: Reported, tmp_path: Path) -> None:
    shown = show(reported.page, tmp_path, DARK, height=6000)
    assert shown.console == []
    assert shown.pixels("surface", dark=True) > shown.picture[..., 0].size / 2
    assert shown.pixels("model_4", dark=True) > 300
    assert shown.pixels("model_4") < 30
