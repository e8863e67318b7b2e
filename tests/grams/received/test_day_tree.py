"""One signature for what a car sends in a day: each message can be checked alone, and no other."""

import base64
import struct
import zlib
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

import fleet_slip
from fleet_slip.errors import InputError
from fleet_slip.grams.received.car_keys import KEYS_VARIABLE
from fleet_slip.grams.received.day_tree import grow
from fleet_slip.grams.received.found_messages import read_messages
from fleet_slip.grams.received.signatures import check_signatures, sign_days, sign_messages
from fleet_slip.models.ed25519 import generate
from tests.support.messages import START_S, gram_of, message_of

DAY_S = 86_400
FORGED = "is not signed by the key of its car"
PRIVATE, PUBLIC = generate()
MIDDLE = PUBLIC.decode().split("\n")[1]
RAW = base64.b64decode(MIDDLE)[-32:]


def day_of(many: int, vehicle: str = "VIN1", day: int = 0) -> list[bytes]:
    """So many messages of a car and a day, ten minutes apart."""
    begin = START_S + DAY_S * day
    return [message_of(gram_of(at % 3), vehicle, begin + 10 * at) for at in range(many)]


def tree_by_the_page(messages: list[bytes], claimed: int | None = None) -> list[bytes]:
    """What docs/edge.md says that a gateway does: a plain recursion, and Ed25519."""
    from cryptography.hazmat.primitives.serialization import load_pem_private_key  # noqa: PLC0415

    levels = 0
    while 2**levels < len(messages):
        levels += 1
    bodies = []
    for message in messages:
        (layout,) = struct.unpack_from("<H", message, 4)
        head = struct.pack("<HH", {1: 16, 3: 64}[layout] + levels, len(message) + 68 + 32 * levels)
        bodies.append(message[:4] + head + message[8:-4])

    def node(level: int, at: int) -> bytes:
        if level == 0:
            return sha256(b"\0" + bodies[at]).digest() if at < len(bodies) else bytes(32)
        below = node(level - 1, 2 * at) + node(level - 1, 2 * at + 1)
        return sha256(b"\1" + below).digest()

    (start_s,) = struct.unpack_from("<Q", messages[0], 36)
    count = len(messages) if claimed is None else claimed
    said = b"fleet-slip gram day\n" + messages[0][16:32]
    said += struct.pack("<IH", start_s // DAY_S, count) + node(levels, 0)
    key: Any = load_pem_private_key(PRIVATE, password=None)
    signed = []
    for at, body in enumerate(bodies):
        path = b"".join(node(level, (at >> level) ^ 1) for level in range(levels))
        whole = body + struct.pack("<HH", at, count) + path + key.sign(said)
        signed.append(whole + struct.pack("<I", zlib.crc32(whole)))
    return signed


def split(content: bytes) -> list[bytes]:
    """The messages that stand one behind the other."""
    found = read_messages(content)
    assert found.refused == []
    return [one.tobytes() for _, run in found.runs for one in run]


def summed(message: bytes) -> bytes:
    """A message that was changed, with the checksum of what it is now."""
    return message[:-4] + struct.pack("<I", zlib.crc32(message[:-4]))


def is_right(message: bytes, key: bytes = RAW) -> bool:
    """Whether one message, alone, is what the key signed."""
    ((_, run),) = read_messages(message).runs
    return bool(check_signatures(run, [key] * len(run)).all())


@pytest.mark.parametrize("many", [1, 2, 3, 4, 5, 12, 17])
def test_each_message_of_a_day_can_be_checked_alone(many: int) -> None:
    messages = day_of(many)
    signed = split(sign_days(b"".join(messages), PRIVATE))
    assert len(signed) == many
    assert all(is_right(one) for one in signed)
    assert len({one[-68:-4] for one in signed}) == 1
    assert signed == tree_by_the_page(messages)
    assert not any(is_right(one, bytes(32)) for one in signed)


def changed(at: int, bits: int = 1) -> Callable[[bytes], bytes]:
    def change(message: bytes) -> bytes:
        whole = bytearray(message)
        whole[at] ^= bits
        return summed(bytes(whole))

    return change


TAIL = 4 + 64 + 4 * 32 + 4
"""Of a message in a tree of four levels: place, path, signature and checksum."""


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(changed(60, 2), id="a sum"),
        pytest.param(changed(19), id="another car"),
        pytest.param(changed(38), id="another moment"),
        pytest.param(changed(-TAIL), id="another place"),
        pytest.param(changed(-TAIL + 1, 0x80), id="a place beyond the tree"),
        pytest.param(changed(-TAIL + 2), id="another number of messages"),
        pytest.param(changed(-TAIL + 4), id="the path at the leaves"),
        pytest.param(changed(-69), id="the path at the root"),
        pytest.param(changed(-68), id="the signature"),
    ],
)
def test_what_was_changed_is_forged(change: Callable[[bytes], bytes]) -> None:
    signed = split(sign_days(b"".join(day_of(12)), PRIVATE))
    assert not is_right(change(signed[5]))
    assert is_right(signed[5])


def test_no_message_takes_the_place_of_another() -> None:
    one, other = split(sign_days(b"".join(day_of(12)), PRIVATE))[4:6]
    assert not is_right(summed(one[:-TAIL] + other[-TAIL:]))


@pytest.mark.parametrize(("vehicle", "day"), [("VIN2", 0), ("VIN1", 1)])
def test_a_tree_is_of_one_car_and_one_day(vehicle: str, day: int) -> None:
    mixed = [*day_of(3), message_of(gram_of(7), vehicle, START_S + DAY_S * day)]
    *own, alien = tree_by_the_page(mixed)
    assert [is_right(one) for one in own] == [True] * 3
    assert not is_right(alien)
    apart = split(sign_days(b"".join(mixed), PRIVATE))
    assert all(is_right(one) for one in apart)
    assert len({one[-68:-4] for one in apart}) == 2


def test_a_node_is_no_message() -> None:
    first, second = day_of(2)
    below = grow([first])[0] + grow([second])[0]
    assert grow([below])[0] != grow([first, second])[0]


def test_a_tree_without_messages_signs_nothing() -> None:
    assert sign_days(b"", PRIVATE) == b""
    assert not is_right(tree_by_the_page(day_of(1), claimed=0)[0])
    assert not is_right(tree_by_the_page(day_of(3), claimed=2)[2])
    assert not is_right(tree_by_the_page(day_of(3), claimed=9)[0])


def test_what_begins_on_no_day_is_not_signed() -> None:
    beyond = message_of(gram_of(1), "VIN1", 2**32 * DAY_S)
    with pytest.raises(InputError, match="VIN1 begins 4,294,967,296 days after 1970: nothing is"):
        sign_days(day_of(1)[0] + beyond, PRIVATE)
    (last,) = split(sign_days(message_of(gram_of(1), "VIN1", 2**32 * DAY_S - 1), PRIVATE))
    assert is_right(last)


def test_a_signature_of_a_day_is_none_of_a_message() -> None:
    (day,) = split(sign_days(day_of(1)[0], PRIVATE))
    single = sign_messages(day_of(1)[0], PRIVATE)
    assert not is_right(summed(single[:-68] + day[-68:]))
    assert not is_right(summed(day[:-68] + single[-68:]))


@pytest.fixture
def fleet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> fleet_slip.Fleet:
    """A root that takes what the key of VIN1 and VIN2 signed."""
    lines = ["vehicle_id,public_key", f"VIN1,{MIDDLE}", f"VIN2,{MIDDLE}"]
    (tmp_path / "keys.csv").write_text("\n".join(lines))
    monkeypatch.setenv(KEYS_VARIABLE, str(tmp_path / "keys.csv"))
    return fleet_slip.open(tmp_path / "data")


def receive(fleet: fleet_slip.Fleet, tmp_path: Path, messages: list[bytes]) -> Any:
    path = tmp_path / f"m{len(list(tmp_path.iterdir()))}"
    path.write_bytes(b"".join(messages))
    (report,) = fleet.receive(path)
    return report


def test_messages_of_a_day_land_in_any_order_and_once(
    fleet: fleet_slip.Fleet, tmp_path: Path
) -> None:
    messages = day_of(6)
    signed = split(sign_days(b"".join(messages), PRIVATE))
    shuffled = [signed[at] for at in (4, 0, 5, 2)]  # two were dropped
    assert receive(fleet, tmp_path, shuffled).received == 4
    report = receive(fleet, tmp_path, [*signed, changed(60, 2)(signed[1])])
    assert (report.received, report.duplicates) == (2, 4)
    assert dict(report.refused) == {FORGED: 1}
    again = split(sign_days(b"".join(messages[:3]), PRIVATE))  # another tree of the same
    assert receive(fleet, tmp_path, again).duplicates == 3


def test_signatures_of_days_are_kept_and_checked_again(
    fleet: fleet_slip.Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    signed = split(sign_days(b"".join(day_of(5) + day_of(1, "VIN2")), PRIVATE))
    single = sign_messages(day_of(1, "VIN2", 1)[0], PRIVATE)
    assert receive(fleet, tmp_path, [*signed, single]).received == 7
    report = fleet.verify(full=True)
    assert (report.signatures, report.signatures_checked, report.damage) == (7, 7, [])
    stranger = generate()[1].decode().split("\n")[1]
    (tmp_path / "keys.csv").write_text(f"vehicle_id,public_key\nVIN1,{stranger}\nVIN2,{MIDDLE}")
    damage = fleet.verify(full=True).damage
    told = [one.problem for one in damage if FORGED in one.problem]
    assert len(told) == 5
    assert all("VIN1-" in one for one in told)
