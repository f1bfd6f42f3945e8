"""The house rules that a machine can check: import directions, file sizes, pinned constraints, what the README says."""

from __future__ import annotations

import ast
import importlib.metadata
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

LONGEST_FILE_LINES = 500
PACKAGES = ("app", "benchmarks", "calibration", "engine_adapters", "storage")
REQUIREMENT = re.compile(r"^(?P<name>[a-z0-9][a-z0-9._-]*)==(?P<version>\S+)", re.IGNORECASE)


def _tracked_files(repository: Path) -> list[Path]:
    """Every file that git tracks or would track."""
    listed = subprocess.run(
        ["git", "-C", str(repository), "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        capture_output=True,
        check=False,
    )
    assert listed.returncode == 0, listed.stderr.decode()
    files = [repository / name for name in listed.stdout.decode().split("\0") if name]
    return sorted(path for path in files if path.is_file())


def _text(path: Path) -> str | None:
    """The file's text, or None for a picture or another binary file."""
    try:
        return path.read_text("utf-8")
    except UnicodeDecodeError:
        return None


def _project(repository: Path) -> dict[str, object]:
    return tomllib.loads((repository / "pyproject.toml").read_text("utf-8"))["project"]


def _pins(constraints: Path) -> dict[tuple[str, str], int]:
    """(name, version with its marker) -> number of hashes, in the order of the file."""
    pins: dict[tuple[str, str], int] = {}
    for entry in constraints.read_text("utf-8").replace("\\\n", " ").splitlines():
        found = REQUIREMENT.match(entry)
        assert found, f"{constraints.name}: not a pinned requirement: {entry[:80]}"
        pins[found["name"], entry.split(" --hash")[0].strip()] = len(re.findall(r"--hash=sha256:[0-9a-f]{64}\b", entry))
    return pins


def test_import_contracts_hold(repository: Path) -> None:
    command = [sys.executable, "-c", "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports())"]
    done = subprocess.run(command, cwd=repository, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_an_import_against_the_direction_is_found(repository: Path, tmp_path: Path) -> None:
    """The contracts can fail: a copy of the layout whose lens maths imports the web framework is refused."""
    for package in PACKAGES:
        for source in (repository / package).rglob("*.py"):
            copy = tmp_path / source.relative_to(repository)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(source.read_bytes())
    (tmp_path / "pyproject.toml").write_bytes((repository / "pyproject.toml").read_bytes())
    with (tmp_path / "calibration" / "errors.py").open("a", encoding="utf-8") as lens:
        lens.write("\nimport engine_adapters.errors\nimport fastapi\n")
    command = [sys.executable, "-c", "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports())"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "calibration is pure numerics BROKEN" in done.stdout
    assert "Four packages, one direction BROKEN" in done.stdout


def test_no_module_reads_the_global_random_state(repository: Path) -> None:
    """``calibration`` takes an ``rng``: ``np.random.default_rng()`` without a seed, or the old global, is not used."""
    found = []
    for source in (repository / "calibration").rglob("*.py"):
        for node in ast.walk(ast.parse(source.read_text("utf-8"))):
            if not isinstance(node, ast.Call):
                continue
            called = ast.unparse(node.func)
            unseeded = called.endswith("random.default_rng") and not node.args and not node.keywords
            legacy = re.fullmatch(r"(np|numpy)\.random\.[a-z_]+", called) and not called.endswith("default_rng")
            if unseeded or legacy:
                found.append(f"{source.relative_to(repository)}:{node.lineno}: {called}")
    assert found == []


def test_no_file_is_too_long(repository: Path) -> None:
    long = {
        str(path.relative_to(repository)): lines
        for path in _tracked_files(repository)
        if path.suffix in {".py", ".js", ".css"} and (lines := len(path.read_bytes().splitlines())) > LONGEST_FILE_LINES
    }
    assert long == {}, "would each be better as two rooms?"


def test_every_module_has_a_docstring_and_late_annotations(repository: Path) -> None:
    lacking = []
    for path in _tracked_files(repository):
        if path.suffix != ".py" or path.name == "noxfile.py":
            continue
        tree = ast.parse(path.read_text("utf-8"))
        if ast.get_docstring(tree) is None:
            lacking.append(f"{path.relative_to(repository)}: no docstring")
        kinds = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
        if any(
            isinstance(node, kinds) for node in ast.walk(tree)
        ) and "from __future__ import annotations" not in path.read_text("utf-8"):
            lacking.append(f"{path.relative_to(repository)}: no 'from __future__ import annotations'")
    assert lacking == []


def test_no_package_index_is_named(repository: Path) -> None:
    """Package names alone: where they come from is each user's own setting."""
    hosts = [["pypi", "org"], ["pythonhosted", "org"], ["npmjs", "org"], ["npmjs", "com"], ["deb.debian", "org"]]
    addresses = re.compile("|".join(re.escape(".".join(host)) for host in hosts) + r"|(extra-)?index-url\s*[= ]\s*\w+:")
    named = [
        str(path.relative_to(repository))
        for path in _tracked_files(repository)
        if (text := _text(path)) is not None and addresses.search(text)
    ]
    assert named == []


def test_every_package_is_typed_and_installed(repository: Path) -> None:
    project = tomllib.loads((repository / "pyproject.toml").read_text("utf-8"))
    assert project["tool"]["mypy"]["packages"] == sorted(PACKAGES)
    assert {pattern.rstrip("*") for pattern in project["tool"]["setuptools"]["packages"]["find"]["include"]} == set(
        PACKAGES
    )
    for package in PACKAGES:
        assert (repository / package / "py.typed").is_file()


def test_what_is_installed_is_complete(repository: Path) -> None:
    """The installed product has every module and data file of the checkout's packages, and no other."""
    try:
        files = importlib.metadata.files("lensmatch")
    except importlib.metadata.PackageNotFoundError:
        files = None
    names = {path.as_posix() for path in files or () if "__pycache__" not in path.parts}
    installed = {name for name in names if name.split("/")[0] in PACKAGES}
    if not installed:
        pytest.skip("lensmatch is not installed here (or as editable): nox installs it")
    ours = {
        path.relative_to(repository).as_posix()
        for path in _tracked_files(repository)
        if path.relative_to(repository).parts[0] in PACKAGES and path.suffix != ".md"
    }
    assert installed == ours


@pytest.mark.parametrize("name", ["runtime.txt", "dev.txt"])
def test_every_pin_has_its_hashes(repository: Path, name: str) -> None:
    pins = _pins(repository / "constraints" / name)
    assert len(pins) > 20
    assert [requirement for requirement, hashes in pins.items() if not hashes] == []
    text = (repository / "constraints" / name).read_text("utf-8")
    assert "://" not in text
    assert " @ " not in text


def test_the_runtime_pins_are_those_of_the_tests(repository: Path) -> None:
    runtime, dev = _pins(repository / "constraints" / "runtime.txt"), _pins(repository / "constraints" / "dev.txt")
    assert set(runtime) - set(dev) == set()


def test_every_dependency_is_pinned_and_bounded(repository: Path) -> None:
    dependencies = _project(repository)["dependencies"]
    assert isinstance(dependencies, list)
    pinned = {name for name, _ in _pins(repository / "constraints" / "runtime.txt")}
    for dependency in dependencies:
        name, bounds = re.match(r"([a-z0-9-]+)(.*)", dependency).groups()
        assert ">=" in bounds, dependency
        assert ",<" in bounds, dependency
        assert name in pinned, f"{dependency}: run python -m nox -s lock"


def test_every_outside_import_is_declared(repository: Path) -> None:
    """A package that the product imports is a dependency of its own, not one that happens to come along."""
    dependencies = _project(repository)["dependencies"]
    assert isinstance(dependencies, list)
    declared = {re.match(r"[a-z0-9-]+", dependency).group().replace("-", "_") for dependency in dependencies}
    modules_of = {
        "opencv_python_headless": "cv2",
        "openexr": "OpenEXR",
        "pillow": "PIL",
        "python_multipart": "multipart",
    }
    known = {modules_of.get(name, name) for name in declared} | set(PACKAGES) | set(sys.stdlib_module_names)
    # click and annotated_types are part of the interface of typer and pydantic.
    known |= {"click", "annotated_types"}
    foreign = set()
    for package in PACKAGES:
        for source in (repository / package).rglob("*.py"):
            for node in ast.walk(ast.parse(source.read_text("utf-8"))):
                names = []
                if isinstance(node, ast.Import):
                    names = [alias.name for alias in node.names]
                elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                    names = [node.module]
                foreign |= {
                    f"{source.relative_to(repository)}: {name}" for name in names if name.split(".")[0] not in known
                }
    assert foreign == set()


def test_version_is_the_changelogs_newest(repository: Path) -> None:
    versions = re.findall(r"^## \[?(\d+\.\d+\.\d+)", (repository / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE)
    assert versions, "CHANGELOG.md has no version heading"
    assert versions[0] == _project(repository)["version"]


def test_ci_runs_what_the_readme_says(repository: Path) -> None:
    readme = (repository / "README.md").read_text("utf-8")
    script = (repository / ".ci" / "run").read_text("utf-8")
    check = "python -m pip install nox && python -m nox"
    assert check in readme
    assert check in script.splitlines()
    assert "python -m pip install . && lensmatch demo" in readme
    first_screen = "\n".join(readme.splitlines()[:40])
    assert check in first_screen
    assert "lensmatch demo" in first_screen
    assert "python -m venv .venv" in readme
