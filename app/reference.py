"""Writes the reference that is made from the code: OpenAPI, schemas, settings. A test checks that it is current.

``python -m app.reference docs/reference``
"""

from __future__ import annotations

import sys
from pathlib import Path

from app import documents, events, job_documents, main, settings
from storage.evidence import evidence_schema_text


def pages() -> dict[str, str]:
    """The generated pages by file name."""
    return {
        "events.schema.json": events.schema_text(),
        "job.schema.json": documents.schema_text(documents.JobRequest),
        "publish.schema.json": documents.schema_text(job_documents.PublishRequest),
        "recheck.schema.json": documents.schema_text(job_documents.RecheckRequest),
        "level-evidence.schema.json": evidence_schema_text(),
        "openapi.json": main.openapi_text(),
        "picture-set.schema.json": documents.schema_text(documents.PictureSet),
        "settings.md": settings.reference_text(),
    }


if __name__ == "__main__":
    for name, text in pages().items():
        (Path(sys.argv[1]) / name).write_text(text, "utf-8", newline="\n")
