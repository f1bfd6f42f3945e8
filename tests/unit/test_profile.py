"""The studio profile: defaults, TOML there and back, one clear line for each mistake."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from pydantic import BaseModel, ValidationError

from calibration.image import Transfer
from engine_adapters.head import OperatorHead, SimulatedHead, build_head
from engine_adapters.ports import HeadState
from engine_adapters.profile import (
    EngineSettings,
    HeadSettings,
    PictureSettings,
    ProfileError,
    R3Settings,
    StudioProfile,
    TrackingSettings,
    load_profile,
    parse_profile,
    profile_sha256,
    profile_toml,
    require_available,
)


def test_no_text_is_all_defaults() -> None:
    assert parse_profile("") == StudioProfile()


def test_the_defaults_are_those_of_the_study() -> None:
    profile = StudioProfile()
    assert (profile.r3.host, profile.r3.port) == ("127.0.0.1", 9009)
    assert profile.mockboard.url == "http://localhost:1987/api/v1/MockCard/MockOutput/GetImage"
    assert profile.r3.exports.k1 == "lens.k1"
    assert profile.engine.radius_unit == "focal_length"
    assert profile.picture.transfer is Transfer.BT709


def test_the_text_reads_back_to_the_same_profile() -> None:
    changed = StudioProfile(
        r3=R3Settings(port=19009, line_ending="crlf", scene="Estúdio/Calibração", connect_timeout_s=0.25),
        engine=EngineSettings(radius_unit="sensor_mm", nodal_sign=-1, tracking_pan="-RotY"),
        picture=PictureSettings(transfer=Transfer.SRGB, image_size=(3840, 2160), pixel_aspect=1.0666),
    )
    for profile in (StudioProfile(), changed):
        assert parse_profile(profile_toml(profile)) == profile
        tomllib.loads(profile_toml(profile))


def test_the_hash_of_a_profile_is_of_what_it_says_not_of_how_it_is_written() -> None:
    bare = parse_profile("")
    assert profile_sha256(bare) == profile_sha256(parse_profile(profile_toml())) == profile_sha256(StudioProfile())
    ordered = parse_profile("[r3]\nport = 9010\nhost = 'a'\n[picture]\npixel_aspect = 1.1")
    turned = parse_profile("picture = {pixel_aspect = 1.1}\nr3 = {host = 'a', port = 9010}")
    assert profile_sha256(ordered) == profile_sha256(turned)
    changed = parse_profile("[r3]\nport = 9011\nhost = 'a'\n[picture]\npixel_aspect = 1.1")
    assert len({profile_sha256(one) for one in (bare, ordered, changed)}) == 3


def test_every_key_stands_in_the_text_under_a_comment() -> None:
    lines = profile_toml().splitlines()

    def check(section: BaseModel) -> int:
        count = 0
        for key, field in type(section).model_fields.items():
            value = getattr(section, key)
            assert field.description, key
            if isinstance(value, BaseModel):
                count += check(value)
            else:
                places = [number for number, line in enumerate(lines) if line.startswith(f"{key} = ")]
                assert places, key
                assert any(lines[place - 1] == f"# {field.description}" for place in places), key
                count += 1
        return count

    assert check(StudioProfile()) == sum(" = " in line and not line.startswith("#") for line in lines)


def test_a_profile_is_frozen() -> None:
    with pytest.raises(ValidationError):
        StudioProfile().r3.port = 1


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("x = 1", "x: unknown key"),
        ("[r3]\nhosst = 'a'", "r3.hosst: unknown key; remove it or check its spelling"),
        ("[r3]\nport = '9009'", "r3.port = '9009': input should be a valid integer"),
        ("[r3]\nport = 0", "r3.port = 0:"),
        ("[r3]\nport = 65536", "r3.port = 65536:"),
        ("[r3]\nport = 2026-01-01", "r3.port = "),
        ("[r3]\nconnect_timeout_s = nan", "r3.connect_timeout_s = nan"),
        ("[r3]\nconnect_timeout_s = 0", "r3.connect_timeout_s = 0"),
        ("[r3]\nscene = 'a\"b'", "r3.scene = 'a\"b': must not hold quotes"),
        ('[r3]\nscene = "a\\nb"', "r3.scene"),
        ("[r3.exports]\nk1 = 'lens.k2'", "two exports have the same name"),
        ("r3 = 1", "r3 = 1: input should be an object"),
        ("[engine]\nradius_unit = 'inch'", "engine.radius_unit = 'inch': input should be 'focal_length'"),
        ("[engine]\nnodal_sign = 2", "engine.nodal_sign = 2"),
        ("[mockboard]\nurl = 'file:///etc/passwd'", "mockboard.url = 'file:///etc/passwd': must be an http"),
        ("[mockboard]\nurl = 'http://user:secret@host/'", "mockboard.url"),
        ("[mockboard]\nurl = 'http://host:99999/'", "mockboard.url"),
        ("[mockboard]\nurl = 'http://[::1/'", "mockboard.url"),
        ("[picture]\nimage_size = [1920]", "picture.image_size"),
        ("[picture]\nimage_size = [0, 1080]", "image_size must be 16 to 16384"),
        ("[picture]\nsensor_mm = [9.59, -1]", "sensor_mm must be"),
        ("[picture]\npixel_aspect = inf", "picture.pixel_aspect = inf"),
        ("[picture]\ntransfer = 'gamma'", "picture.transfer = 'gamma'"),
        ("a = [", "is not TOML"),
        ("[r3]\nport = 1\nport = 2", "is not TOML"),
        (f"a = {'9' * 5000}", "is not TOML"),
        (f"a = {'[' * 5000}", "is not TOML"),
    ],
)
def test_each_mistake_is_one_line_with_file_and_key(text: str, told: str) -> None:
    with pytest.raises(ProfileError) as caught:
        parse_profile(text, where="studio.toml")
    assert str(caught.value).startswith("studio.toml: ")
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)


def test_every_mistake_is_told_at_once() -> None:
    with pytest.raises(ProfileError) as caught:
        parse_profile("[r3]\nport = 0\nhosst = 'a'\n[head]\nkind = 'robot'")
    assert [problem.split(" ")[0].rstrip(":") for problem in caught.value.problems] == [
        "r3.port",
        "r3.hosst",
        "head.kind",
    ]


def test_a_secret_in_an_address_is_not_repeated() -> None:
    with pytest.raises(ProfileError) as caught:
        parse_profile("[mockboard]\nurl = 'http://user:secret@host/'")
    assert "secret" not in str(caught.value)


def test_a_file_is_read_with_its_name_in_every_error(tmp_path: Path) -> None:
    good = tmp_path / "studio.toml"
    good.write_bytes(b"\xef\xbb\xbf[r3]\r\nport = 1234\r\n")
    assert load_profile(good).r3.port == 1234
    bad = {
        "missing.toml": None,
        "latin.toml": b"# \xe9\n",
        "large.toml": b"#" * (1024 * 1024 + 1),
        "wrong.toml": b"[r3]\nport = 0\n",
    }
    for name, data in bad.items():
        if data is not None:
            (tmp_path / name).write_bytes(data)
        with pytest.raises(ProfileError, match=name):
            load_profile(tmp_path / name)
    with pytest.raises(ProfileError):
        load_profile(tmp_path)
    with pytest.raises(ProfileError):
        load_profile("a\x00b")


def test_what_is_not_available_yet_says_so() -> None:
    require_available(StudioProfile())
    profile = StudioProfile(
        head=HeadSettings(kind="visca"),
        tracking=TrackingSettings(kind="freed"),
    )
    with pytest.raises(ProfileError) as caught:
        require_available(profile)
    assert [problem.split(" ")[0] for problem in caught.value.problems] == [
        "head.kind",
        "tracking.kind",
    ]
    assert all("not available yet" in problem for problem in caught.value.problems)


async def test_heads_are_built_by_their_kind() -> None:
    async def ask(text: str) -> HeadState | None:
        return None

    assert isinstance(build_head(HeadSettings(), ask=ask), OperatorHead)
    simulated = build_head(HeadSettings(kind="simulated"), ask=ask)
    assert isinstance(simulated, SimulatedHead)
    await simulated.close()
    with pytest.raises(ProfileError, match="not available yet"):
        build_head(HeadSettings(kind="visca"), ask=ask)
