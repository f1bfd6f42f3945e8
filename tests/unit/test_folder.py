"""Pictures from a folder: all of those in it, none outside it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from engine_adapters.errors import BadPicture, UnsafeText
from engine_adapters.folder import FolderPictures

PNG = b"\x89PNG\r\n\x1a\n" + bytes(50)


@pytest.fixture
def pictures(tmp_path: Path) -> FolderPictures:
    root = tmp_path / "set"
    (root / "z0_f0").mkdir(parents=True)
    (root / "z0_f0" / "side.png").write_bytes(PNG)
    (root / "Ä b.JPG").write_bytes(b"\xff\xd8\xff\xe0")
    (root / "set.json").write_text("{}")
    (root / "text.png").write_text("no picture")
    (root / "empty.png").write_bytes(b"")
    (tmp_path / "outside.png").write_bytes(PNG)
    return FolderPictures(root)


def test_names_are_the_picture_files_sorted(pictures: FolderPictures) -> None:
    assert pictures.names() == ["empty.png", "text.png", "z0_f0/side.png", "Ä b.JPG"]


async def test_a_picture_is_read_as_it_is(pictures: FolderPictures) -> None:
    frame = await pictures.read("z0_f0/side.png")
    assert frame.data == PNG
    assert frame.source == "z0_f0/side.png"
    assert frame.requested_at_s <= frame.received_at_s
    assert (await pictures.read("./z0_f0//side.png")).data == PNG
    assert (await pictures.read("Ä b.JPG")).data.startswith(b"\xff\xd8\xff")


@pytest.mark.parametrize(
    "name",
    [
        "",
        ".",
        "..",
        "../outside.png",
        "z0_f0/../../outside.png",
        "z0_f0/../z0_f0/side.png",
        "/etc/passwd",
        "//stranger/share/x.png",
        "\\\\stranger\\share\\x.png",
        "\\\\?\\C:\\x.png",
        "..\\outside.png",
        "C:/x.png",
        "C:x.png",
        "c:\\x.png",
        "z0_f0/side.png:stream",
        "file:///etc/passwd",
        "CON",
        "con.png",
        "z0_f0/NUL.png",
        "COM1",
        "lpt9.txt.png",
        "side.png ",
        "side.png.",
        "z0_f0 /side.png",
        ".../side.png",
        "~/side.png",
        "a\x00.png",
        "a\n.png",
        "a\u202egnp.png",
        "a/" * 600 + "b.png",
    ],
)
async def test_a_name_that_leads_out_is_refused(pictures: FolderPictures, name: str) -> None:
    with pytest.raises(UnsafeText):
        await pictures.read(name)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("missing.png", "cannot be read"),
        ("z0_f0", "not a file"),
        ("text.png", "not a PNG"),
        ("empty.png", "empty"),
        ("set.json", "not a PNG"),
        ("%2e%2e/outside.png", "cannot be read"),
        ("x" * 300 + ".png", "cannot be read"),
    ],
)
async def test_what_is_no_picture_is_told_with_its_name(pictures: FolderPictures, name: str, told: str) -> None:
    with pytest.raises(BadPicture, match=told) as caught:
        await pictures.read(name)
    assert caught.value.where == name


async def test_the_size_is_bounded(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(PNG)
    assert (await FolderPictures(tmp_path, limit_bytes=len(PNG)).read("a.png")).data == PNG
    with pytest.raises(BadPicture, match="larger than"):
        await FolderPictures(tmp_path, limit_bytes=len(PNG) - 1).read("a.png")


async def test_a_link_that_leads_out_is_refused_and_not_listed(pictures: FolderPictures, tmp_path: Path) -> None:
    try:
        (tmp_path / "set" / "link.png").symlink_to(tmp_path / "outside.png")
        (tmp_path / "set" / "dir").symlink_to(tmp_path, target_is_directory=True)
        (tmp_path / "set" / "inside.png").symlink_to(tmp_path / "set" / "z0_f0" / "side.png")
        (tmp_path / "set" / "loop.png").symlink_to(tmp_path / "set" / "loop.png")
    except OSError:
        pytest.skip("this system lets only an administrator make links")
    for name in ("link.png", "dir/outside.png"):
        with pytest.raises(UnsafeText, match="leads out"):
            await pictures.read(name)
    with pytest.raises(BadPicture):
        await pictures.read("loop.png")
    assert (await pictures.read("inside.png")).data == PNG
    assert "link.png" not in pictures.names()
    assert "inside.png" in pictures.names()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
async def test_a_pipe_does_not_hang(pictures: FolderPictures, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "set" / "pipe.png")
    with pytest.raises(BadPicture, match="not a file"):
        await pictures.read("pipe.png")


def test_a_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(BadPicture, match="no such folder"):
        FolderPictures(tmp_path / "missing")
