"""Templates of pages."""

from __future__ import annotations

from typing import Any


def filled(package: str, template: str, *, escaped: bool = True, **content: Any) -> str:
    """A page, from the template next to the code that fills it; a value that it lacks is an error.

    Args:
        package: of the template.
        template: name of its file.
        escaped: the page is HTML, in which the text of values is escaped.
        content: values by name.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader(package, "."),
        autoescape=escaped,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**content)
