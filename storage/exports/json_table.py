"""The lens table as JSON (``docs/reference/lens-table.schema.json``): carries everything, exactly."""

from __future__ import annotations

import json
from typing import NoReturn

from calibration.tables import LensTable
from storage.errors import BadDocument
from storage.exports.base import Export, decode_text
from storage.schemas import document_to_table, table_to_document


def write_json(table: LensTable) -> bytes:
    """The table as UTF-8 JSON; floats with all their digits, the same bytes for the same table."""
    text = json.dumps(table_to_document(table), indent=1, ensure_ascii=False, allow_nan=False)
    return text.encode("utf-8") + b"\n"


def read_json(data: bytes) -> LensTable:
    """The table of a JSON file. Raises :class:`BadDocument`."""
    text = decode_text(data)
    try:
        document = json.loads(text, parse_constant=_refuse_constant)
    except json.JSONDecodeError as error:
        raise BadDocument(
            f"line {error.lineno}, column {error.colno}",
            f"is not JSON ({error.msg})",
            "the file is damaged or of another format; export it again",
        ) from error
    except (RecursionError, ValueError) as error:
        why = "is nested too deeply" if isinstance(error, RecursionError) else f"holds a number too long ({error})"
        raise BadDocument("", why, "is this a lens table file?") from error
    return document_to_table(document)


def _refuse_constant(name: str) -> NoReturn:
    raise BadDocument("", f"holds {name}, which is no number", "a value that is not known is null, with its reason")


JSON_TABLE = Export(
    name="json",
    title="Lensmatch lens table",
    suffix=".json",
    media_type="application/json",
    write=write_json,
    read=read_json,
)
