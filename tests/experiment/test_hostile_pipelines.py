"""Pipelines that mean harm: each is refused in lines that are few, short and printable."""

import os
import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sweep.errors import PipelineError
from sweep.experiment.pipeline import Pipeline, cell
from sweep.messages import MAX_FAULTS, MAX_LINE_LENGTH

POSE = "[pose]\ndistance_m = 1\n"
AXES = POSE + "jitter_px = 1\n[axes]\n"
DEEP = ".a" * 7
MANY = range(2000)


def faults_of(read, *arguments, **options):
    """Return what is told of a pipeline that must be refused; every line is fit to be printed."""
    with pytest.raises(PipelineError) as told:
        read(*arguments, **options)
    lines = str(told.value).split("\n")
    assert len(lines) <= MAX_FAULTS + 1
    assert all(line.isprintable() and 0 < len(line) <= MAX_LINE_LENGTH for line in lines)
    return lines


HOSTILE = {
    # Axes without end, in every form.
    "range": (AXES + "marker_id = { range = [0, 1000000000000] }", "at most 1,000,000,000 values"),
    "linspace": (AXES + "tilt_deg = { linspace = [0, 1, 1000000000000] }", "at most 1,000,000"),
    "arange, least step": (AXES + "tilt_deg = { arange = [0, 1e299, 5e-324] }", "at most 1,000"),
    "trial": (AXES + "trial = 1000000000000", "from 1 to 1,000,000,000"),
    "axes that are long together": (
        AXES + "tilt_deg = { linspace = [0, 1, 600000] }\nroll_deg = { linspace = [0, 1, 600000] }",
        "axes.roll_deg = {linspace = [0, 1, 600000]}: expected at most 1,000,000 values, all axes",
    ),
    "a product": (
        AXES + "trial = 1000000000\nmarker_id = { range = [0, 50000] }", "poses: expected at most",
    ),
    "detector settings times estimators": (
        AXES + "minOtsuStdDev = { linspace = [0, 9, 1000] }\n"
        "believed_size_m = { linspace = [0.1, 1, 1000] }",
        "axes: 1e+06 detector settings times estimators: expected at most 10,000",
    ),
    "a frame too large": (
        POSE + "[camera]\nwidth_px = 100000\nheight_px = 100000\n",
        "camera.height_px = 100000: expected a frame of at most 500,000,000 pixels",
    ),
    # Nesting, and what takes time that grows with a square.
    "lists": ("x = " + "[" * 100_000, "not TOML: nested too deeply"),
    "tables, closed": (POSE + "tilt_deg = " + "{a=" * 200 + "1" + "}" * 200, "= {a = {a = "),
    "a dotted key": ("a" + ".a" * 100_000 + " = 1", "expected keys of at most 8 parts"),
    "quotes, none a key": (POSE + "x = '" + '"\\' * 50_000 + "'", "pose.x: unknown key"),
    # Size.
    "text": ("# " + "x" * 10_000_000, "expected at most 250,000 bytes"),
    "unknown keys": (POSE + "".join(f"k{i} = 1\n" for i in MANY), "... and 1,980 faults more"),
    "a key": (POSE + "k" * 200_000 + " = 1", "kkk...: unknown key"),
    "values": (AXES + f"tilt_deg = [{'1,' * 100_000}]", "each value once (1.0 is repeated)"),
    "a title": (f'title = "{"k" * 1000}"\n' + POSE, "one line of at most 200 characters"),
    "a path": (POSE + f'[scene]\nbackground = "{"a/" * 100_000}"', "(File name too long)"),
    # Numbers without end.
    "digits": (POSE + "tilt_deg = 1" + "0" * 100_000, "not TOML: Exceeds the limit (4300 digits)"),
    **{
        f"hexadecimal digits, {name}": (text % ("0x1" + "0" * 20_000), expected)
        for name, text, expected in (
            ("a value", POSE + "tilt_deg = %s", "pose.tilt_deg = 0x1000"),
            ("a list", AXES + "tilt_deg = [%s]", "(not 0x1000"),
            ("a range", AXES + "marker_id = { range = [0, %s] }", "expected range ="),
        )
    },
    # What a terminal would obey, or take for a line of ours.
    "control characters, a key": (
        POSE + '"\\u001b[2J\\nforged: line" = 1', "pose.\\u001b[2J\\nforged: line: unknown key",
    ),
    "control characters, a value": (
        POSE + 'tilt_deg = "\\u009b31m\\u202e\\u2028\\n"',
        'tilt_deg = "\\u009b31m\\u202e\\u2028\\n": expected',
    ),
    "half a character": (POSE + "# \ud800", "expected UTF-8"),
}


@pytest.mark.parametrize(("text", "expected"), HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_text_is_refused_in_short_lines(text, expected):
    assert any(expected in line for line in faults_of(Pipeline.from_text, text))


SETTINGS = [
    ("tilt_deg=" + "[" * 50_000, "expected a TOML value", "expected a TOML value"),
    ("tilt_deg=0x1" + "0" * 5000, "tilt_deg = 0x1", "expected a number"),
    ("\x1b\nforged: x=3", "--set \\u001b\\nforged: x=3: unknown",
     "\\u001b\\nforged: x=3: unknown parameter"),
    ('title="\udcff"', "expected a TOML value", None),
    ("x=1," * 10_000, "expected a TOML value", "... and 9,980 faults more"),
    ("background=\udcff", "expected a TOML value", "expected a TOML value"),
]


@pytest.mark.parametrize(("setting", "expected", "at"), SETTINGS)
def test_a_hostile_setting_or_place_is_refused_in_short_lines(setting, expected, at):
    assert any(expected in line for line in faults_of(Pipeline.from_text, POSE, [setting]))
    if at is not None:
        assert any(at in line for line in faults_of(cell, Pipeline.from_text(POSE), setting))


def test_a_file_with_a_byte_order_mark_is_read(tmp_path):
    (tmp_path / "p.toml").write_bytes(b"\xef\xbb\xbf" + POSE.encode())
    assert Pipeline.from_toml(tmp_path / "p.toml").fixed["distance_m"] == 1
    (tmp_path / "p.toml").write_bytes(b"\xff\xfe\x00")
    assert "expected UTF-8: byte 0 is not" in faults_of(Pipeline.from_toml, tmp_path / "p.toml")[0]


@settings(derandomize=True, deadline=None, max_examples=100)
@given(st.one_of(
    st.text(),
    st.binary().map(lambda data: data.decode("latin-1")),
    st.lists(st.sampled_from([
        "[pose]\n", "[axes]\n", "[scene]\n", "distance_m", "tilt_deg", "trial", "background", "=",
        "{", "}", "[", "]", ",", ".", "linspace", "range", "values", "uniform", "0", "1", "-7",
        "1e999", "nan", "0x" + "f" * 4000, '"', "'", "\\", "\n", "\r\n", "#", "2020-01-01", "true",
        "\x1b", "\u202e", "é",
    ]), max_size=40).map("".join),
))
def test_any_text_is_a_pipeline_or_is_refused(text):
    for arguments in ((text,), (POSE, [text]), (POSE, ["tilt_deg=" + text])):
        try:
            Pipeline.from_text(*arguments)
        except PipelineError as told:
            lines = str(told).split("\n")
            assert len(lines) <= MAX_FAULTS + 1
            assert all(line.isprintable() and 0 < len(line) <= MAX_LINE_LENGTH for line in lines)


# Files.

def png(width, height, data):
    """Return a PNG file that declares a size and has any data."""
    def chunk(kind, content):
        body = kind + content
        return struct.pack(">I", len(content)) + body + struct.pack(">I", zlib.crc32(body))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return (b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(data, 9))
            + chunk(b"IEND", b""))


def encoded(ending, image):
    return cv2.imencode(ending, image)[1].tobytes()


NOISE = np.random.default_rng(0).integers(0, 255, (48, 64), dtype=np.uint8)
FRAME = POSE + "[camera]\nwidth_px = 64\nheight_px = 48\n[scene]\nbackground = '%s'\n"
JPEG = encoded(".jpg", NOISE)

BROKEN_IMAGES = {
    "empty": (b"", "not an image"),
    "a header alone": (encoded(".png", NOISE)[:33], "not an image"),
    "half a JPEG": (JPEG[:1500], "not an image"),
    "too little data": (png(64, 48, b"\0" * 100), "not an image"),
    "no pixels": (png(0, 0, b""), "not an image"),
    "a TIFF": (encoded(".tiff", NOISE), "not an image that OpenCV can read: a PNG, JPEG, BMP"),
    "another size": (encoded(".png", NOISE[:40]), "it is 64 x 40, but height_px = 48"),
}


@pytest.mark.parametrize(("content", "expected"), BROKEN_IMAGES.values(), ids=BROKEN_IMAGES)
def test_an_image_that_is_none_is_refused(content, expected, tmp_path, capfd):
    (tmp_path / "image").write_bytes(content)
    lines = faults_of(Pipeline.from_text, FRAME % "image", folder=tmp_path)
    assert expected in lines[0]
    assert capfd.readouterr().err == ""


def test_special_files_are_refused_unread(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "zero").symlink_to("/dev/zero")
    with (tmp_path / "large").open("wb") as file:
        file.write(encoded(".png", NOISE))
        file.truncate(10**10)
    for name, expected in (
        ("pipe", "Not a regular file"), ("folder", "Is a directory"), ("loop", "symbolic links"),
        ("zero", "Not a regular file"), ("large", "bytes"),
    ):
        for line, in (faults_of(Pipeline.from_toml, tmp_path / name),
                      faults_of(Pipeline.from_text, FRAME % name, folder=tmp_path)):
            assert expected in line
