"""Jinja2 templates of all HTML pages: a base page, macros of shared parts, and the environment with autoescape."""

from functools import cache

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

from registration.report.heat_map import UNMEASURED
from registration.report.pictures import COLOUR_SCALE


@cache
def environment(*packages: str) -> Environment:
    """Return the environment for the templates of this folder and of further packages' `templates` folders.

    Everything that a template inserts is escaped, except `markupsafe.Markup`. A name without a value is an error.
    Pages extend `base.html`; `parts.html` holds the macros that they share.

    Args:
        packages: import names of packages with a folder `templates`, such as "workflows.pages".
    """
    loaders = [PackageLoader(package) for package in ("registration.report", *packages)]
    result = Environment(
        loader=ChoiceLoader(loaders),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    result.filters["words"] = lambda name: str(name).replace("_", " ")
    result.filters["capitalise"] = lambda text: f"{text[:1].upper()}{text[1:]}"  # `capitalize` lowers the rest
    result.globals["COLOUR_SCALE"] = ", ".join(f"rgb{colour}" for colour in COLOUR_SCALE)  # stops of a CSS gradient
    result.globals["UNMEASURED"] = f"rgb{UNMEASURED}"
    return result
