"""What all pages share: how templates are filled in, and their look."""

from importlib.resources import files
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup

from fleet_slip.pages.style import PALETTE

TEMPLATES = files("fleet_slip.pages") / "templates"


def fill_in(template: str, **values: Any) -> str:
    """Return a page: a template with values, and the style sheet and colours of all pages."""
    environment = Environment(
        loader=FunctionLoader(lambda name: (TEMPLATES / name).read_text(encoding="utf-8")),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page = environment.get_template(template).render(
        css=Markup((TEMPLATES / "report.css").read_text(encoding="utf-8")),  # noqa: S704
        palette={name.replace("_", "-"): tone for name, tone in PALETTE.items()},
        **values,
    )
    return page + "\n"
