"""The evidence of a level as a reader sees it: its verdict, tests, pictures and correlations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from app.report.numbers import pixels

_SHORT = {
    "f_px": "f",
    "center_shift_x_px": "shift x",
    "center_shift_y_px": "shift y",
    "nodal_offset_mm": "nodal",
}
_BAR_END = 3.0
# Mean squared whitened residual at which a picture's bar is full; 1 is what noise alone gives.


@dataclass(frozen=True, slots=True)
class Correlation:
    """A cell of the correlation table; ``shade`` 0..100 is its strength, ``sign`` plus or minus."""

    text: str
    shade: int
    sign: str


@dataclass(frozen=True, slots=True)
class PictureBar:
    """A picture's mean chi2: ``bar`` is its length in percent, ``odd`` that noise alone hardly gives it."""

    name: str
    points: str
    rms: str
    chi2: str
    p_value: str
    held_out: str
    bar: int
    odd: bool


@dataclass(frozen=True, slots=True)
class MistakeRow:
    """A possible mistake of survey, board, head or camera; ``shown``: the pictures show it."""

    name: str
    estimate: str
    prior: str
    verdict: str
    shown: bool


@dataclass(frozen=True, slots=True)
class EvidenceView:
    """What the page says of a level's evidence."""

    sentence: str
    flagged: bool
    facts: tuple[tuple[str, str], ...]
    tests: tuple[tuple[str, str, str, bool], ...]
    names: tuple[str, ...]
    correlations: tuple[tuple[str, tuple[Correlation, ...]], ...]
    pictures: tuple[PictureBar, ...]
    cells: tuple[tuple[int, ...], ...]
    outliers: tuple[tuple[str, str, str, str], ...]
    hashes: tuple[tuple[str, str], ...]
    mistakes: tuple[MistakeRow, ...]


def evidence_view(document: Mapping[str, Any]) -> EvidenceView:
    """The view of a document as :func:`storage.evidence.evidence_to_document` makes it."""
    names = tuple(_SHORT.get(name, name) for name in document["parameters"])
    misfit = document["misfit"]
    return EvidenceView(
        sentence=misfit["sentence"],
        flagged=misfit["flagged"],
        facts=tuple(_facts(document)),
        tests=tuple(
            (
                test["name"],
                "" if test["size_px"] is None else pixels(test["size_px"]),
                _probability(test["p_value"]),
                test["p_value"] < 1e-3,
            )
            for test in misfit["tests"]
        ),
        names=names,
        correlations=tuple(
            (name, tuple(_correlation(value) for value in row))
            for name, row in zip(names, document["correlation"], strict=True)
        ),
        pictures=tuple(_bar(picture) for picture in document["pictures"]),
        cells=tuple(tuple(row) for row in document["coverage"]["cells"]),
        outliers=tuple(
            (o["picture"], str(o["point"]), _or_none(o["distance_px"]), _or_none(o["sigmas"], 1))
            for o in document["outliers"]
        ),
        hashes=tuple((p["name"], p["sha256"] or "unknown") for p in document["inputs"]["pictures"]),
        mistakes=tuple(_mistake(mistake) for mistake in document.get("mistakes", ())),
    )


def _mistake(mistake: Mapping[str, Any]) -> MistakeRow:
    name, subject, unit = mistake["name"], mistake["subject"], mistake["unit"]
    sigma = "–" if mistake["sigma"] is None else f"{mistake['sigma']:.2g}"
    return MistakeRow(
        f"{name} of {subject}" if subject else name,
        f"{mistake['estimate']:+.3g} ± {sigma} {unit}".replace("-", "−").rstrip(),
        f"{mistake['prior_sigma']:.2g} {unit}".rstrip(),
        mistake["verdict"],
        mistake["verdict"] == "shown",
    )


def _facts(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    noise, coverage = document["noise"], document["coverage"]
    fold, parallax = document["fold_margin"], document.get("parallax")
    facts = [
        ("noise expected / found", f"{pixels(noise['expected_px'])} / {pixels(noise['found_px'])} px"),
        ("floor added", f"{pixels(noise['floor_px'])} px"),
        ("chi2 / degrees of freedom", f"{document['chi2']:.0f} / {document['dof']:.0f}"),
        ("points left out", f"{len(document['outliers'])} ({document['outlier_share']:.1%})"),
        ("frame covered", f"{coverage['share']:.0%} of its cells, out to {coverage['radius_share']:.0%} of its corner"),
        ("corners expected to", f"{_or_none(coverage['corner_px'])} px"),
        ("fold", "never" if fold is None else f"at {fold:.2f} × the corner's radius"),
    ]
    if parallax is not None:
        near_m, far_m, pan_deg = parallax["near_m"], parallax["far_m"], parallax["pan_deg"]
        as_given, sigma = pixels(parallax["as_given_px"]), pixels(parallax["sigma_px"])
        name = f"parallax of {near_m:.3g} m against {far_m:.3g} m, pan over {pan_deg:.3g}°"
        facts.append((name, f"{as_given} px with the nodal offset as given, ± {sigma} px"))
    return facts


def _correlation(value: float) -> Correlation:
    return Correlation(f"{value:+.2f}".replace("-", "−"), round(abs(value) * 100), "minus" if value < 0 else "plus")


def _bar(picture: Mapping[str, Any]) -> PictureBar:
    mean = picture["chi2"] / picture["dof"] if picture["dof"] > 0 else 0.0
    held = picture["held_out_px"]
    return PictureBar(
        picture["name"],
        f"{picture['used']} of {picture['points']}",
        _or_none(picture["rms_px"]),
        f"{mean:.2f}",
        _probability(picture["p_value"]),
        "–" if held is None else f"{pixels(held['rms'])} / {pixels(held['max'])}",
        round(100 * min(mean / _BAR_END, 1.0)),
        picture["p_value"] is not None and picture["p_value"] < 1e-3,
    )


def _probability(value: float | None) -> str:
    if value is None:
        return "–"
    return "< 0.0001" if value < 1e-4 else f"{value:.4f}" if value < 1e-2 else f"{value:.2f}"


def _or_none(value: float | None, digits: int | None = None) -> str:
    if value is None:
        return "–"
    return pixels(value) if digits is None else f"{value:.{digits}f}"
