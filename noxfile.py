"""What is run to check Lensmatch: ``python -m nox`` does all of it, ``python -m nox -l`` lists the parts.

Everything is installed from ``constraints/dev.txt``: exact versions, each with its hashes, for every platform.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import nox

if sys.version_info < (3, 11):
    sys.exit(f"Lensmatch needs Python 3.11 or later; this is {sys.version.split()[0]}: start nox with a newer Python")

nox.needs_version = ">=2024.4.15"
nox.options.sessions = ["tests"]
nox.options.default_venv_backend = "virtualenv"
nox.options.reuse_existing_virtualenvs = True
nox.options.error_on_external_run = True

CONSTRAINTS = Path("constraints")
LOCK_TOOL = nox.project.dependency_groups(nox.project.load_toml("pyproject.toml"), "lock")
COMPILE = (
    "uv", "pip", "compile", "--universal", "--fork-strategy", "fewest", "--python-version", "3.11", "--generate-hashes",
    "--no-emit-index-url", "--no-emit-find-links", "--no-header", "--no-annotate", "--quiet",
)  # fmt: skip


def install(session: nox.Session) -> None:
    """The pinned tools and libraries, then the product itself, built with the pinned setuptools."""
    session.install("--require-hashes", "-r", str(CONSTRAINTS / "dev.txt"))
    # A module that was removed would live on in what the last build left here.
    shutil.rmtree("build", ignore_errors=True)
    session.install("--no-deps", "--no-build-isolation", ".")


def check(session: nox.Session) -> None:
    """Style, types and import directions."""
    session.run("ruff", "check", ".")
    session.run("ruff", "format", "--check", ".")
    session.run("mypy")
    session.run("lint-imports", "--no-cache")


@nox.session
def tests(session: nox.Session) -> None:
    """Check style, types and imports, then run every test (pytest's closing line comes last)."""
    install(session)
    check(session)
    session.run("pytest", *session.posargs)


@nox.session
def lint(session: nox.Session) -> None:
    """Check style, types and imports only."""
    install(session)
    check(session)


@nox.session
def lowest(session: nox.Session) -> None:
    """Run the tests with the oldest versions that pyproject.toml admits (same Python, nothing pinned by hash)."""
    session.install(*LOCK_TOOL)
    oldest = Path(session.create_tmp()) / "lowest.txt"
    session.run("uv", "pip", "compile", "--resolution", "lowest-direct", "--group", "dev", "--quiet",
                "pyproject.toml", "-o", str(oldest))  # fmt: skip
    session.install("-r", str(oldest))
    session.install("--no-deps", "--no-build-isolation", ".")
    session.run("pytest", *session.posargs)


@nox.session
def fresh(session: nox.Session) -> None:
    """Install as a user does, nothing pinned, and run the demo on two levels."""
    session.install(".")
    session.run("lensmatch", "demo", "--zooms", "2", "--focuses", "1", "--out", session.create_tmp())


@nox.session
def lock(session: nox.Session) -> None:
    """Pin the newest versions that pyproject.toml admits: rewrites the files in constraints/."""
    session.install(*LOCK_TOOL)
    dev, runtime = CONSTRAINTS / "dev.txt", CONSTRAINTS / "runtime.txt"
    session.run(*COMPILE, "--upgrade", "pyproject.toml", "--group", "dev", "-o", str(dev))
    session.run(
        *COMPILE, "--upgrade", "pyproject.toml", "--group", "build", "--constraints", str(dev), "-o", str(runtime)
    )
