"""Brings a version into a registry from the JSON document that another data root exported."""

import base64
import binascii
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fleet_slip.canonical import canonical_json, sha256_of
from fleet_slip.config import parse_document, read_named_file
from fleet_slip.errors import InputError, RefusedError, StorageError
from fleet_slip.export.compile import compile_program
from fleet_slip.export.document import FORMAT, SCHEMA, program_content
from fleet_slip.files.documents import checksum
from fleet_slip.models.manifest import ImportedFrom, Manifest
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.models.trained_drives import checksum_of_drives
from fleet_slip.models.versions import Registry

LONGEST_FILE_BYTES = 2**28


def import_version(registry: Registry, file: Path) -> ModelVersion:
    """Add the version of a document as the next of its model, to which nothing points yet.

    It says where it comes from. If the model's latest version is the same estimator, that is the
    result. Raises `InputError` for a file that is no such document or was changed, and
    `RefusedError` if a signal means something else here.
    """
    content = _read(file)
    model = content["model"]
    manifest = _manifest(file, model)
    drives = _drives(file, model, manifest)
    if program_content(compile_program(manifest)) != content["program"]:
        raise RefusedError(
            f"{file}: its signals have other scales or ranges than configs/signals.toml says here, "
            "so that its counts would mean something else."
        )
    origin = manifest.imported_from or ImportedFrom(
        reference=model["reference"], sha256=model["sha256"]
    )
    return registry.add(manifest.model_copy(update={"imported_from": origin}), drives)


def _read(file: Path) -> dict[str, Any]:
    """Return a document whose checksum is right. Raises `InputError` for anything else."""
    text = read_named_file(file, LONGEST_FILE_BYTES, InputError)
    try:
        content = json.loads(text)
        known = (content["format"], content["schema"])
        stated = content.pop("sha256")
        found = sha256_of(canonical_json(content))
        _ = content["model"]["manifest"], content["program"]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise InputError(f"{file}: is no exported version. {_EXPORT}") from None
    if known != (FORMAT, SCHEMA):
        raise InputError(f"{file}: has format {known[0]!r}, schema {known[1]!r}. {_EXPORT}")
    if stated != found:
        raise InputError(f"{file}: was changed or damaged: its SHA-256 is another. {_EXPORT}")
    return dict(content)


_EXPORT = "Export it again with: fleet-slip export NAME@VERSION --to json"


def _manifest(file: Path, model: Mapping[str, Any]) -> Manifest:
    try:
        manifest = parse_document(model["manifest"], Manifest, str(file), "its manifest")
        reference, stated = str(model["reference"]), model["sha256"]
    except (StorageError, KeyError) as error:
        raise InputError(f"{file}: is no version that this program knows: {error}") from None
    if checksum(model["manifest"]) != stated or reference.partition("@")[0] != manifest.name:
        raise InputError(f"{file}: its manifest is not that of {reference[:100]!r}. {_EXPORT}")
    return manifest


def _drives(file: Path, model: Mapping[str, Any], manifest: Manifest) -> bytes | None:
    """Return what tells the version's drives; None if nothing ever did."""
    trained = manifest.trained_on
    if trained.drives_sha256 is None:
        return None
    expected = trained.drives_sha256
    try:
        content = base64.b64decode(model["drives"], validate=True)
    except (KeyError, TypeError, ValueError, binascii.Error):
        content = b""
    if checksum_of_drives(content) != expected:
        raise InputError(f"{file}: lacks the hashes of the drives that trained it. {_EXPORT}")
    return content
