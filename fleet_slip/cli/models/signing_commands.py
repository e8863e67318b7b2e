"""Commands that make keys and sign model versions: keygen, sign."""

import os
from pathlib import Path
from typing import Annotated

import typer

from fleet_slip.cli.completing import complete_model
from fleet_slip.cli.output import say
from fleet_slip.errors import UsageError
from fleet_slip.models.signing import SIGNING_VARIABLE, VERIFY_VARIABLE, make_keys

SignKey = Annotated[
    Path | None,
    typer.Option(
        "--sign-key",
        help=f"Private key to sign the version with. Default: ${SIGNING_VARIABLE}.",
        show_default=False,
    ),
]


def signing_key(given: Path | None) -> Path | None:
    """Return the private key that versions are signed with: the option, else the environment's."""
    return given or (Path(named) if (named := os.environ.get(SIGNING_VARIABLE)) else None)


def keygen(
    file: Annotated[Path, typer.Argument(help="Where to write the private key; FILE.pub is made.")],
) -> None:
    """Make a key to sign model versions with. Keep it where versions are made, and nowhere else.

    Example: **fleet-slip keygen release**
    """
    public = make_keys(file)
    say(f"{file}: the private key. To sign: export {SIGNING_VARIABLE}={file}")
    say(f"{public}: the public key. To demand signatures: export {VERIFY_VARIABLE}={public}")


def sign(
    context: typer.Context,
    reference: Annotated[str, typer.Argument(help="NAME@VERSION", autocompletion=complete_model)],
    sign_key: SignKey = None,
) -> None:
    """Sign a version that was published without a signature.

    Example: **fleet-slip sign waterford@1 --sign-key release.key**
    """
    key = signing_key(sign_key)
    if key is None:
        raise UsageError(f"no key to sign with. Give --sign-key FILE, or set ${SIGNING_VARIABLE}.")
    version = context.obj.sign(reference, key)
    say(f"{version.reference} is signed")
