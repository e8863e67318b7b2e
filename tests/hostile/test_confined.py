"""A reader of other people's that would do harm, or take a night down: it cannot, and others land.

What takes the place of npTDMS here is the reader with a hole that nobody knows of yet.
"""

import os
import platform
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nptdms import ChannelObject

import fleet_slip
from fleet_slip.errors import InputError
from fleet_slip.ingest.formats import reading as confined
from fleet_slip.ingest.formats import source as budget
from tests.support.commands import until
from tests.support.measured import failure, read_measured
from tests.support.tdms_files import own_clock, wave, write

HARM = """
def open_other(): open({secret!r}).read()
def list_other(): os.listdir({folder!r})
def write_other(): open({folder!r} + "/written", "w")
def change_other(): os.chmod({secret!r}, 0); os.stat({secret!r}).st_mode & 0o777 and fail()
def connect(): socket.create_connection(("127.0.0.1", {port}))
def make_socket(): socket.socket(socket.AF_UNIX)
def run(): subprocess.run(["/bin/true"])
def fork(): os.fork() or os._exit(0)
def signal_parent(): os.kill(os.getppid(), 0)
def signal_tester(): os.kill({pid}, 0)
def read_environment(): os.environ["{variable}"]
def read_tester(): open("/proc/{pid}/environ").read()
def limit_tester(): resource.prlimit({pid}, resource.RLIMIT_CORE)
def schedule_tester(): os.sched_setscheduler({pid}, os.SCHED_BATCH, os.sched_param(0))
def delay_tester(): call({ioprio_set}, 1, {pid}, 0)
def make_memory(): os.memfd_create("x")
def attach_memory(): call({shmctl}, 0, 0, 0)
"""


FAKE = """
import ctypes, fcntl, json, os, resource, socket, stat, struct, subprocess, sys, tempfile, time
def call(*numbers):
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.syscall(*numbers) < 0 and ctypes.get_errno() == 1:
        raise PermissionError
class log:
    class log_manager:
        set_level = staticmethod(print)
class TdmsFile:
    @staticmethod
    def open(stream):
        exec(stream.read()[4:].decode(), globals())
"""
"""A package of this name that does what a file says."""


@pytest.fixture(scope="module")
def fake_server(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("packages")
    (folder / "nptdms").mkdir()
    (folder / "nptdms" / "__init__.py").write_text(FAKE)
    with pytest.MonkeyPatch.context() as patched:
        patched.syspath_prepend(str(folder))
        return confined._server.__wrapped__(0)


@pytest.fixture
def fake_reader(fake_server: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Write a file that has its reader do something."""
    monkeypatch.setattr(confined, "_server", lambda _: fake_server)

    def write_it(text: str) -> Path:
        file = tmp_path / "log.tdms"
        file.write_text("TDSm" + text)
        return file

    return write_it


def test_a_reader_can_do_no_harm(
    fake_reader: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SOME_TOKEN", "secret")
    secret = tmp_path / "secret"
    secret.write_text("secret")
    settings = {"secret": str(secret), "folder": str(tmp_path), "port": 1, "pid": os.getpid()}
    is_arm = platform.machine() == "aarch64"
    numbers = {"ioprio_set": 30 if is_arm else 251, "shmctl": 195 if is_arm else 31}
    harm = HARM.format(**settings, **numbers, variable="SOME_TOKEN")
    names = [line.split("(")[0].removeprefix("def ") for line in harm.split("\n") if line]
    done = f"""
def fail(): raise PermissionError
done = []
for one in ({", ".join(names)}):
    try:
        one()
    except (PermissionError, KeyError):
        continue
    except Exception as error:
        done.append(type(error).__name__)
    done.append(one.__name__)
raise ValueError("done: " + json.dumps(done))
"""
    assert "done: []" in failure(fake_reader(harm + done), own_clock())
    assert secret.read_text() == "secret"
    assert not (tmp_path / "written").exists()


@pytest.mark.parametrize(
    ("harm", "why"),
    [
        ("ctypes.string_at(0)", "its reader crashed"),
        ("os._exit(0)", "its reader crashed"),
        ("sys.exit(3)", "its reader crashed"),
        ("time.sleep(100)", "took more than"),
        ("bytearray(2**27)", "more than"),
        ("tempfile.TemporaryFile().write(bytes(2**24))", "more than"),
    ],
    ids=["fault", "end", "exit", "time", "memory", "disk"],
)
def test_harm_by_a_reader_is_a_fault_of_the_file(
    fake_reader: Any, monkeypatch: pytest.MonkeyPatch, harm: str, why: str
) -> None:
    monkeypatch.setattr(budget, "FREE_S", 0.3)
    monkeypatch.setattr(budget, "FREE_MEMORY", 2**26)
    monkeypatch.setattr(budget, "FREE_BYTES", 2**22)
    assert why in failure(fake_reader(harm), own_clock())


@pytest.mark.parametrize(
    "files",
    [
        "[tempfile.TemporaryFile() for _ in range(8)]",
        "[open(os.path.join(tempfile.gettempdir(), str(n)), 'wb') for n in range(8)]",
    ],
    ids=["deleted", "present"],
)
@pytest.mark.timeout(60)
def test_temporary_files_are_bounded_together(
    fake_reader: Any, monkeypatch: pytest.MonkeyPatch, files: str
) -> None:
    monkeypatch.setattr(budget, "FREE_BYTES", 2**22)
    monkeypatch.setattr(budget, "FREE_S", 30)
    harm = f"files = {files}\nfor file in files: file.write(bytes(2**20)), file.flush()\n"
    assert "in a temporary file" in failure(fake_reader(f"{harm}time.sleep(100)"), own_clock())


def test_answers_of_a_reader_are_checked(fake_reader: Any) -> None:
    for answer in (
        'struct.pack("<QQ", 2**40, 0)',
        'struct.pack("<QQ", 2, 2**60) + b"{}"',
        'struct.pack("<QQ", 2, 0) + b"[]"',
        'struct.pack("<QQ", 2, 0) + b"x["',
        'struct.pack("<QQ", 31, 0) + json.dumps({"error": "os", "text": "\\x1b"}).encode()',
        "b''",
    ):
        text = f"""
def is_socket(number):
    try: return stat.S_ISSOCK(os.fstat(number).st_mode)
    except OSError: return False
socket.socket(fileno=next(n for n in range(3, 99) if is_socket(n))).sendall({answer})
os._exit(0)
"""
        message = failure(fake_reader(text), own_clock())
        assert "its reader crashed" in message or "x1b" in message


def scaled(file: Path, scales: dict[str, Any]) -> Path:
    """A sound TDMS file but for the scales of one channel."""
    ax = ChannelObject("g", "ax", np.arange(100) / 100, {**wave(0.01), **scales})
    return write(file, [ax, ChannelObject("g", "beta", np.zeros(100), wave(0.01))])


def nested(file: Path) -> Path:
    """A TDMS file of 60 scales, each the sum of the one before and itself."""
    properties = {"NI_Number_Of_Scales": np.uint32(60)}
    for number in range(60):
        properties[f"NI_Scale[{number}]_Scale_Type"] = "Add"  # type: ignore[assignment]
        for side in ("Left", "Right"):
            source = np.uint32(number - 1 if number else 0xFFFFFFFF)
            properties[f"NI_Scale[{number}]_Add_{side}_Operand_Input_Source"] = source
    return scaled(file, properties)


def test_a_file_that_never_ends_holds_no_night_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(budget, "FREE_S", 1.0)
    monkeypatch.setattr(budget, "FREE_MEMORY", 2**27)
    endless = nested(tmp_path / "a.tdms")
    many = scaled(tmp_path / "b.tdms", {"NI_Number_Of_Scales": np.uint32(3 * 10**7)})
    good = scaled(tmp_path / "c.tdms", {})
    fleet = fleet_slip.open(tmp_path / "data")
    with pytest.raises(InputError) as caught:
        fleet.ingest([endless, many, good], own_clock())
    assert f"{endless}: decoding it took" in str(caught.value)
    assert f"{many}: it" in str(caught.value)
    assert "2 files cannot be used; all others are stored." in str(caught.value)
    assert fleet.sql("SELECT count(*) FROM log").fetchall() == [(100,)]


def test_readers_go_with_who_asks_them_and_others_come(tmp_path: Path) -> None:
    file = nested(tmp_path / "a.tdms")
    server, _ = confined._server(os.getpid())
    with ThreadPoolExecutor(1) as thread:
        failed = thread.submit(failure, file, own_clock())
        children = Path(f"/proc/{server.pid}/task/{server.pid}/children")
        until(children.read_text)
        reader = Path("/proc", children.read_text().strip())
        server.kill()
        assert "its reader crashed" in failed.result()
    until(lambda: not reader.exists())
    good = scaled(tmp_path / "b.tdms", {})
    assert read_measured(good, own_clock()).counts.ticks == 100
    confined._server(os.getpid())[0].kill()  # it may be dying when the next file comes
    assert read_measured(good, own_clock()).counts.ticks == 100
