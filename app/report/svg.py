"""Finished pieces of SVG, told apart from text that still has to be escaped."""

from __future__ import annotations

import html


class Svg(str):
    """Markup that is finished: Jinja puts it into a page as it is (the ``__html__`` protocol)."""

    __slots__ = ()

    def __html__(self) -> str:
        return str(self)


def svg(template: str, *values: object) -> Svg:
    """``template.format(*values)`` with every text in ``values`` escaped; numbers and finished pieces stay."""
    return Svg(template.format(*(v if isinstance(v, Svg | int | float) else html.escape(str(v)) for v in values)))
