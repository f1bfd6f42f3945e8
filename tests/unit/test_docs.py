"""The documentation is true: marked snippets run, JSON is JSON, links lead somewhere.

A fence that says ``bash run`` holds ``lensmatch ...`` lines, each run as a process in an empty folder; one that says
``python run`` is executed there. Other fences are for reading.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from app.documents import PictureSet
from app.job_documents import parse_job
from storage.schemas import document_to_table, table_to_document

REPOSITORY = Path(__file__).resolve().parents[2]
PAGES = sorted([*REPOSITORY.glob("*.md"), *(REPOSITORY / "docs").rglob("*.md")])
FENCE = re.compile(r"^(?P<indent> *)```(?P<info>[^\n`]*)\n(?P<body>.*?)^(?P=indent)```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\((?P<target>[^)\s]+)\)")
COMMAND_TIMEOUT_S = 100
"""The longest run of one command in the documentation; a demo of a few levels takes seconds."""


@dataclass(frozen=True)
class Snippet:
    """One fenced block: where it stands, what its fence says, and its text."""

    page: Path
    line: int
    info: str
    body: str

    def __str__(self) -> str:
        return f"{self.page.relative_to(REPOSITORY).as_posix()}:{self.line}"


def _snippets(page: Path) -> list[Snippet]:
    text = page.read_text("utf-8")
    found = []
    for fence in FENCE.finditer(text):
        line = text.count("\n", 0, fence.start()) + 1
        body = "\n".join(row.removeprefix(fence["indent"]) for row in fence["body"].splitlines())
        found.append(Snippet(page, line, fence["info"].strip(), body))
    return found


SNIPPETS = [snippet for page in PAGES for snippet in _snippets(page)]


def _marked(info: str) -> list[Snippet]:
    return [snippet for snippet in SNIPPETS if snippet.info == info]


@pytest.mark.parametrize("snippet", _marked("bash run"), ids=str)
def test_commands_run(snippet: Snippet, tmp_path: Path) -> None:
    for line in snippet.body.splitlines():
        words = shlex.split(line, comments=True)
        if not words:
            continue
        assert words[0] == "lensmatch", f"{snippet}: only lensmatch is run, not {words[0]}"
        done = subprocess.run(
            [sys.executable, "-m", "app", *words[1:]],
            cwd=tmp_path,
            # The checkout goes first on the path, so that the documentation is tried on what stands beside it.
            env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
            capture_output=True,
            text=True,
            encoding="utf-8",
            timeout=COMMAND_TIMEOUT_S,
            check=False,
        )
        assert done.returncode == 0, f"{snippet}: {line}\n{done.stdout}\n{done.stderr}"


@pytest.mark.parametrize("snippet", _marked("python run"), ids=str)
def test_python_runs(snippet: Snippet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile(snippet.body, str(snippet), "exec"), {"__name__": "snippet"})


@pytest.mark.parametrize("snippet", _marked("json"), ids=str)
def test_json_is_json(snippet: Snippet) -> None:
    assert isinstance(json.loads(snippet.body), dict)


def _examples(page: str) -> list[str]:
    return [snippet.body for snippet in _marked("json") if snippet.page == REPOSITORY / "docs" / page]


@pytest.mark.parametrize("page", ["reference/picture-set.md", "how-to/calibrate-from-pictures.md"])
def test_picture_set_examples_are_accepted(page: str) -> None:
    assert _examples(page)
    for example in _examples(page):
        PictureSet.model_validate_json(example)


def test_job_examples_are_accepted() -> None:
    assert _examples("reference/job.md")
    for example in _examples("reference/job.md"):
        parse_job(json.loads(example))


def test_lens_table_examples_are_accepted() -> None:
    assert _examples("reference/lens-table.md")
    for example in _examples("reference/lens-table.md"):
        table = document_to_table(json.loads(example))
        assert table_to_document(table)["levels"]


def test_fences_say_only_what_is_known() -> None:
    known = {"", "json", "toml", "bash run", "python", "python run"}
    assert [f"{snippet}: {snippet.info}" for snippet in SNIPPETS if snippet.info not in known] == []


def test_there_are_snippets_to_run() -> None:
    assert _marked("bash run")
    assert _marked("python run")


def _anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as code hosts make them."""
    headings = re.findall(r"^#+ +(.+)$", page.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(REPOSITORY).as_posix())
def test_links_lead_somewhere(page: Path) -> None:
    prose = FENCE.sub("", page.read_text("utf-8"))
    broken = []
    for link in LINK.finditer(prose):
        target, _, anchor = link["target"].partition("#")
        if "://" in target:
            continue
        file = (page.parent / target).resolve() if target else page
        if not file.exists() or (anchor and file.suffix == ".md" and anchor not in _anchors(file)):
            broken.append(link["target"])
    assert broken == []


def test_every_page_can_be_reached() -> None:
    """A link to the page, or to the folder that it stands in."""
    linked = {
        (page.parent / link["target"].partition("#")[0]).resolve()
        for page in PAGES
        for link in LINK.finditer(page.read_text("utf-8"))
    }
    lost = [page for page in (REPOSITORY / "docs").rglob("*.md") if not {page, page.parent} & linked]
    assert [page.relative_to(REPOSITORY).as_posix() for page in lost if page.name != "README.md"] == []
