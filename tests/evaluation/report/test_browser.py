"""The page as a browser shows it."""

import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from fleet_slip.pages.drawing import PALETTE
from tests.support.reported import Reported

DESK_PX = 1200
LONG_PX = 16000
DARK = "--blink-settings=preferredColorScheme=0"

pytestmark = pytest.mark.tools("chromium")


@dataclass(frozen=True)
class Shown:
    """What came out of a browser: a picture of shape (height, width, 3), and its console."""

    picture: NDArray[np.uint8]
    console: list[str]

    def pixels(self, name: str, *, dark: bool = False) -> int:
        tone = PALETTE[name]
        wanted = [int((tone.dark if dark else tone.light)[i : i + 2], 16) for i in (1, 3, 5)]
        return int((self.picture == wanted).all(axis=2).sum())


def show(
    page: Path, folder: Path, *flags: str, width: int = DESK_PX, height: int = LONG_PX
) -> Shown:
    shot = folder / "shot.png"
    done = subprocess.run(
        [
            "chromium",
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-dev-shm-usage",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--hide-scrollbars",
            "--host-resolver-rules=MAP * ~NOTFOUND",
            "--enable-logging=stderr",
            f"--user-data-dir={folder / 'profile'}",
            f"--window-size={width},{height}",
            f"--screenshot={shot}",
            *flags,
            page.as_uri(),
        ],
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
    )
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


def test_a_phone_gets_drawings_of_its_own(reported: Reported, tmp_path: Path) -> None:
    frame = tmp_path / "phone.html"
    frame.write_text(
        f'<body style="margin: 0"><iframe src="{reported.page.as_uri()}" '
        f'style="width: 390px; height: 8000px; border: 0"></iframe>'
    )
    shown = show(frame, tmp_path, width=500, height=8000)
    phone = Shown(shown.picture[:, :390], shown.console)
    assert phone.console == []
    assert phone.pixels("model_4") > 300
    beside = shown.picture[:, 390:]
    assert (beside == 255).all()
