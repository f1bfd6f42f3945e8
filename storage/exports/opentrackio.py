"""OpenTrackIO 1.0.1 (SMPTE RIS OSVP), with the lens equations of OpenLensIO 1.0: a JSON array, one sample per level.

The standard knows samples, not files: an array adds no key of its own, and each element is a whole sample that can be
checked, sent or pasted alone. A single sample is read as well.

Units and signs of the format: millimetres on the sensor from its centre, x right, y down; F = ``pinholeFocalLength``,
dP = ``projectionOffset``, r in mm, ``radial`` = [l1, l2, ...] with odd ones above and even ones below the line:

    eps' = F (x, y);   eps'' = eps' (1 + l1 r^2 + l3 r^4 + l5 r^6) / (1 + l2 r^2 + l4 r^4 + l6 r^6);   eps = eps'' + dP

"Brown-Conrady U-D" maps undistorted to distorted, as here: l1 = k1/F^2, l2 = 0, l3 = k2/F^4, exact. The default model
"Brown-Conrady D-U" maps the other way and is refitted over the picture, with as many of six terms as bring the overlay
error below :data:`GOAL_PX`. dP = (w/W) sx, (h/H) sy: the centre shift counts from the picture's centre, so that the
half pixel between pixel centres at whole and at half numbers is accounted for exactly. Encoders 0..1 as here.

``entrancePupilOffset`` counts from the imaging plane and is never written: the table's nodal offset counts from the
pivot, and where the imaging plane stands behind it is not known. It goes, with what else has no field, into the
top-level key ``lensmatch``, the place where the schema allows other keys. Tangential terms and ``distortionOffset`` are
not in the lens model here: not written, and refused where they are not 0. ``overscan`` is left to the receiver.
"""

from __future__ import annotations

import json
import math
import uuid
from dataclasses import replace
from functools import partial
from typing import Any

from calibration.compare import Overlay
from calibration.errors import CalibrationError
from calibration.lens import Lens
from calibration.refit import InverseRadial, best_inverse
from calibration.tables import LensTable, LevelResult
from storage.errors import BadDocument, CannotExport
from storage.exports.base import (
    EVIDENCE_LOST,
    UNKNOWN_TIME,
    Export,
    Head,
    Mark,
    decode_text,
    head_of,
    lens_levels,
    lens_of_file,
    mark_of,
    noted_level,
    noted_table,
    parse_json,
    provenance_of,
    read_level,
    read_note,
    read_table,
)
from storage.exports.millimetres import (
    check_count,
    degraded_by,
    exact_sensor_mm,
    pixel_aspect_of,
    refit_advice,
    refit_note,
    refitted_lens,
    unfolded_lens,
)
from storage.exports.opentrackio_sample import DU, UD, Distortion, Sample, Static
from storage.schemas import validated

VERSION = (1, 0, 1)
GOAL_PX = 1e-3
"""The D-U refit takes more terms until no pixel is off by more."""

_CARRIER = "OpenTrackIO"
_AGAIN = "correct it, or export it again"
_TERMS = ((1, 0), (1, 1), (2, 1), (2, 2), (3, 2), (3, 3))
# Numerator and denominator of ``radial`` lists of one to six numbers.
_LONGEST_TEXT = 1023
_NAMESPACE = uuid.UUID("6f2b1a52-2f5e-5c0b-9d53-6f1c6c0e8f11")
# For name-based identifiers: the same table gives the same bytes.
_ASPECT_TOLERANCE = 1e-6


def write_opentrackio(table: LensTable, model: str = UD) -> bytes:
    """The table as a JSON array of samples in one of the two models. Raises :class:`CannotExport`."""
    levels = lens_levels(table)
    sensor_mm = exact_sensor_mm(table, _CARRIER)
    samples = [_sample(table, level, sensor_mm, model) for level in levels]
    return json.dumps(samples, indent=1, ensure_ascii=False, allow_nan=False).encode("utf-8") + b"\n"


def read_opentrackio(data: bytes) -> LensTable:
    """The table of a sample, or of an array of samples, in either model. Raises :class:`BadDocument`."""
    document = parse_json(decode_text(data), "")
    samples, static = _samples(document)
    head = _head(samples, static)
    if head is not None and isinstance(document, dict):
        head = head.model_copy(update={"levels": 1})  # one sample, taken out of its file
    levels, refits = [], []
    for place, sample in samples:
        level, left = _read_level(place, sample, static, head)
        levels.append(level)
        if left is not None:
            refits.append(left)
    note = refit_note(refits)
    if head is not None:
        return noted_table(data, _CARRIER, head, levels, note)
    camera = static.camera
    return read_table(
        data,
        _CARRIER,
        levels,
        lens=_name(static.lens.make, static.lens.model),
        camera=camera.label or _name(camera.make, camera.model),
        created=UNKNOWN_TIME,
        image_size=camera.image_size,
        sensor_mm=camera.sensor_mm,
        pixel_aspect=pixel_aspect_of(camera.image_size, camera.sensor_mm),
        note=note,
    )


def advice_du(table: LensTable) -> str:
    """How exact the refit of :data:`DU` is. Raises :class:`CannotExport`."""
    return refit_advice((level, _refit(unfolded_lens(table, level), level)[1]) for level in lens_levels(table))


def _sample(table: LensTable, level: LevelResult, sensor_mm: tuple[float, float], model: str) -> dict[str, Any]:
    for name, value in (("zoom", level.zoom), ("focus", level.focus)):
        if not 0 <= value <= 1:
            raise CannotExport(f"{_CARRIER} has encoder values from 0 to 1, and this table a level at {name} {value:g}")
    lens = unfolded_lens(table, level)
    width, height = table.image_size
    focal_mm = lens.f_px * sensor_mm[0] / width
    fields: dict[str, Any] = {
        "encoders": {"focus": level.focus, "zoom": level.zoom},
        "pinholeFocalLength": focal_mm,
    }
    note: dict[str, Any] = {"table": head_of(table), "level": mark_of(level)}
    if level.center_shift_px is not None:
        sx, sy = level.center_shift_px
        fields["projectionOffset"] = {"x": sx * sensor_mm[0] / width, "y": sy * sensor_mm[1] / height}
    if level.k1 is not None or level.k2 is not None:
        radial = [lens.k1 / focal_mm**2, 0.0, lens.k2 / focal_mm**4]
        if model == DU:
            inverse, left = _refit(lens, level)
            radial = _radial(inverse.in_unit(1 / focal_mm))
            note["refit_px"] = {"rms": left.rms_px, "max": left.max_px}
        fields["distortion"] = [{"model": model, "radial": radial}]
    history = [f"{name}: {text}"[:_LONGEST_TEXT] for name, text in provenance_of(table).items()]
    return {
        "protocol": {"name": _CARRIER, "version": list(VERSION)},
        "sampleId": _urn(table, repr(level.zoom), repr(level.focus)),
        "sourceId": _urn(table),
        "static": {
            "camera": {
                "activeSensorPhysicalDimensions": {"width": sensor_mm[0], "height": sensor_mm[1]},
                "activeSensorResolution": {"width": width, "height": height},
                "label": table.camera,
            },
            "lens": {"model": table.lens, "calibrationHistory": history},
        },
        "lens": fields,
        "lensmatch": note,
    }


def _refit(lens: Lens, level: LevelResult) -> tuple[InverseRadial, Overlay]:
    try:
        return best_inverse(lens, _TERMS, GOAL_PX)
    except CalibrationError as error:
        raise CannotExport(f"zoom {level.zoom:g}, focus {level.focus:g}: {error}; export it as opentrackio") from error


def _radial(inverse: InverseRadial) -> list[float]:
    """Numerator and denominator in turn, as the format lists them."""
    radial = [0.0] * (2 * max(len(inverse.numerator), len(inverse.denominator)))
    radial[0 : 2 * len(inverse.numerator) : 2] = inverse.numerator
    radial[1 : 2 * len(inverse.denominator) + 1 : 2] = inverse.denominator
    return radial if len(inverse.denominator) == len(inverse.numerator) else radial[:-1]


def _urn(table: LensTable, *parts: str) -> str:
    facts = [table.lens, table.camera, str(table.version), table.created.isoformat(), *parts]
    return uuid.uuid5(_NAMESPACE, "\n".join(facts)).urn


def _samples(document: object) -> tuple[list[tuple[str, Sample]], Static]:
    """The samples of a file, each with its place, and the static block that they share."""
    if not document or not isinstance(document, list | dict):
        raise BadDocument("", "is neither a sample nor an array of samples", "is this an OpenTrackIO file?")
    listed = [("", document)] if isinstance(document, dict) else [(f"[{n}]", found) for n, found in enumerate(document)]
    check_count(len(listed))
    samples: list[tuple[str, Sample]] = []
    static: Static | None = None
    for place, found in listed:
        _check_protocol(place, found)
        sample = validated(Sample, found, place)
        static = static or sample.static
        if static is None:
            raise BadDocument(_at(place, "static"), "is missing: sensor and picture size", "send a whole sample")
        if sample.static not in (None, static):
            raise BadDocument(
                _at(place, "static"), "differs from the one before", "put each camera into a file of its own"
            )
        samples.append((place, sample))
    if static is None:
        raise BadDocument("", "has no sample", "export it again")
    return samples, static


def _check_protocol(place: str, sample: object) -> None:
    protocol = sample.get("protocol") if isinstance(sample, dict) else None
    if not isinstance(protocol, dict) or protocol.get("name") != _CARRIER:
        raise BadDocument(_at(place, "protocol.name"), f"is not {_CARRIER}", "is this an OpenTrackIO sample?")
    if protocol.get("version") != list(VERSION):
        shown = str(protocol.get("version"))[:40]
        raise BadDocument(
            _at(place, "protocol.version"),
            f"is {shown}, this program reads {list(VERSION)}",
            "send samples of that version",
        )


def _head(samples: list[tuple[str, Sample]], static: Static) -> Head | None:
    """The note of the table, None in a foreign file; all samples must have the same."""
    first = samples[0][1].lensmatch
    for place, sample in samples[1:]:
        if (sample.lensmatch and sample.lensmatch.table) != (first and first.table):
            raise BadDocument(_at(place, "lensmatch.table"), "differs from the first sample's", _AGAIN)
    if first is None:
        return None
    place = _at(samples[0][0], "lensmatch.table")
    head = read_note(Head, first.table, place)
    (width, height), sensor_mm = static.camera.image_size, static.camera.sensor_mm
    aspect = (height / sensor_mm[1]) / (width / sensor_mm[0])
    if head.image_size != (width, height) or not math.isclose(head.pixel_aspect, aspect, rel_tol=_ASPECT_TOLERANCE):
        raise BadDocument(place, "contradicts the sensor's size in px and mm", _AGAIN)
    return head


def _read_level(place: str, sample: Sample, static: Static, head: Head | None) -> tuple[LevelResult, Overlay | None]:
    """A sample's level, and the overlay error left by its refit, None where there was none."""
    told, camera = sample.lens, static.camera
    if camera.anamorphic_squeeze.num != camera.anamorphic_squeeze.denom:
        raise BadDocument("static.camera.anamorphicSqueeze", "is not 1", "anamorphic lenses are not in this lens model")
    offset = told.distortion_offset
    if offset is not None and (offset.x, offset.y) != (0, 0):
        raise BadDocument(
            _at(place, "lens.distortionOffset"), "is not 0", "a lens here has one centre: send it as projectionOffset"
        )
    (width, height), sensor_mm = camera.image_size, camera.sensor_mm
    aspect = head.pixel_aspect if head is not None else pixel_aspect_of(camera.image_size, sensor_mm)
    mark = None
    if head is not None and sample.lensmatch is not None:
        mark = read_note(Mark, sample.lensmatch.level, _at(place, "lensmatch.level"))
    shift_px = (0.0, 0.0)
    if told.projection_offset is not None:
        shift_px = told.projection_offset.x * width / sensor_mm[0], told.projection_offset.y * height / sensor_mm[1]
    nodal_mm = mark.nodal_offset_mm if mark is not None else None
    frame = lens_of_file(
        _at(place, "lens"),
        camera.image_size,
        told.pinhole_focal_length * width / sensor_mm[0],
        center_shift_px=shift_px,
        pixel_aspect=aspect,
        nodal_offset_mm=nodal_mm,
    )
    lens, left = frame, None
    if told.distortion is not None:
        lens, left = _distorted(_at(place, "lens.distortion"), told.distortion, frame, told.pinhole_focal_length)
    absent = {"k1", "k2"} if told.distortion is None else set()
    if told.projection_offset is None:
        absent.add("center_shift_px")
    zoom, focus = told.encoders.zoom, told.encoders.focus
    if mark is None:
        degraded = degraded_by(left) if left is not None else None
        missing = {*absent, "nodal_offset_mm"}
        return read_level(zoom, focus, lens, _CARRIER, missing=missing, degraded=degraded), left
    if (mark.zoom, mark.focus) != (zoom, focus) or not absent <= {*mark.untold}:
        raise BadDocument(_at(place, "lensmatch.level"), "contradicts the sample's lens", _AGAIN)
    if left is not None and mark.degraded is None:
        mark = mark.model_copy(update={"degraded": degraded_by(left)})
    return noted_level(mark, lens, _CARRIER), left


def _distorted(
    place: str, distortions: tuple[Distortion, ...], frame: Lens, focal_mm: float
) -> tuple[Lens, Overlay | None]:
    """The frame with its distortion: that of the U-D model where there is one, else of the D-U model, refitted."""
    models = [distortion.model for distortion in distortions]
    for model in models:
        if models.count(model) > 1:
            raise BadDocument(place, f"has the model {model[:40]!r} twice", _AGAIN)
    chosen = next((d for model in (UD, DU) for d in distortions if d.model == model), None)
    if chosen is None:
        raise BadDocument(place, f"has no model that is read: {UD}, {DU}", "send one of them")
    if any(chosen.tangential):
        raise BadDocument(place, "has tangential terms", "this lens model has none: calibrate without them")
    if chosen.model == DU:
        try:
            inverse = InverseRadial.from_unit(chosen.radial[0::2], chosen.radial[1::2], 1 / focal_mm)
        except (CalibrationError, OverflowError) as error:
            raise BadDocument(_at(place, "radial"), "is too large to be a lens", _AGAIN) from error
        return refitted_lens(frame, inverse, _at(place, "radial"))
    terms = [*chosen.radial, 0.0, 0.0]
    if any(terms[1:2] + terms[3:]):
        why = "has other terms than the first and third"
        raise BadDocument(_at(place, "radial"), why, "this lens model has k1 and k2 only: calibrate the lens with them")
    f2 = focal_mm * focal_mm
    try:
        return replace(frame, k1=terms[0] * f2, k2=terms[2] * f2 * f2), None
    except CalibrationError as error:
        raise BadDocument(_at(place, "radial"), str(error), _AGAIN) from error


def _at(place: str, name: str) -> str:
    return f"{place}.{name}" if place else name


def _name(*parts: str | None) -> str:
    return " ".join(part for part in parts if part) or "unknown"


_NOT_CARRIED = (
    EVIDENCE_LOST,
    "the nodal offset as entrancePupilOffset, which counts from the imaging plane: it stands, from the pivot, in the "
    "key lensmatch, which other programs ignore",
)

OPENTRACKIO = Export(
    name="opentrackio",
    title="OpenTrackIO 1.0.1 samples, exact (Brown-Conrady U-D)",
    suffix=".opentrackio.json",
    media_type="application/json",
    write=write_opentrackio,
    read=read_opentrackio,
    cannot_carry=_NOT_CARRIED,
)
OPENTRACKIO_DU = Export(
    name="opentrackio-du",
    title="OpenTrackIO 1.0.1 samples, refitted (Brown-Conrady D-U, the default model)",
    suffix=".opentrackio.json",
    media_type="application/json",
    write=partial(write_opentrackio, model=DU),
    read=read_opentrackio,
    cannot_carry=(*_NOT_CARRIED, "k1 and k2 themselves: they are refitted there and back"),
    advice=advice_du,
)
