"""The tool that shows what a colour range takes in."""

import cv2
import numpy as np
import pytest

from common.console import Console
from services.robot_bridge.target_detection import TARGET_COLOURS, ColourRange, ColourSpace, colour_mask
from services.robot_bridge.tasks import tune
from services.robot_bridge.tasks.tune import LONGEST_SIDE, main, read_picture, variations
from services.robot_bridge.tasks.tune_sheet import _INSIDE, GAP, LABEL_HEIGHT, TILE_WIDTH, draw_sheet
from tests.helpers import unusable_output


def picture(directory, colour=(0, 0, 255), height=90, width=160, name="picture.png"):
    """A grey picture with a rectangle of 200 pixels in a colour, blue first; the file's path."""
    drawn = np.full((height, width, 3), 128, np.uint8)
    drawn[30:40, 40:60] = colour
    path = directory / name
    assert cv2.imwrite(str(path), drawn)
    return path


def run(capsys, *arguments):
    """Return exit code, output and errors."""
    code = main([str(argument) for argument in arguments])
    output = capsys.readouterr()
    return code, output.out, output.err


def test_it_tells_the_share_for_each_bound_and_draws_the_masks(tmp_path, capsys):
    code, out, err = run(capsys, "--image", picture(tmp_path), "--out", tmp_path / "new" / "out", "--robot", "ur5")
    assert (code, err) == (0, "")
    lines = out.splitlines()
    # 200 of 14 400 pixels; from 128 on, red is all that keeps the grey out, so only blue and green can let it in.
    assert lines[0].startswith("ur5: B 0-50  G 0-50  R 120-255: 1.39 % of the picture; largest blob 1.39 %")
    assert "centre (-0.38, -0.22)" in lines[0]
    bounds = [line.split("%")[0].split() for line in lines[1:-2]]
    assert [bound for _, _, bound, _ in bounds] == [
        *("20", "30", "40", "50", "60", "70", "80"),
        *("20", "30", "40", "50", "60", "70", "80"),
        *("90", "100", "110", "120", "130", "140", "150"),
    ]
    assert {share for *_, share in bounds} == {"1.39"}
    assert [line.split()[:3] for line in lines if "as given" in line] == [
        ["B", "<=", "50"],
        ["G", "<=", "50"],
        ["R", ">=", "120"],
    ]
    assert lines[-2].strip() == str(tmp_path / "new" / "out" / "ur5.png")
    assert cv2.imread(lines[-2].strip()) is not None


def test_without_a_choice_every_robot_has_its_sheet(tmp_path, capsys):
    code, _, _ = run(capsys, "--image", picture(tmp_path), "--out", tmp_path)
    assert code == 0
    assert sorted(path.stem for path in tmp_path.glob("*.png")) == sorted([*TARGET_COLOURS, "picture"])


def test_a_range_of_ones_own_is_varied_as_wide_and_as_often_as_told(tmp_path, capsys):
    image = picture(tmp_path, colour=(0, 200, 0))  # hue 60
    arguments = ("--low", "50,100,100", "--high", "70,255,255", "--spread", "12", "--columns", "3")
    code, out, _ = run(capsys, "--image", image, "--out", tmp_path, *arguments)
    assert code == 0
    shares = {line.split("%")[0][:10].strip(): line.split("%")[0].split()[-1] for line in out.splitlines()[1:-2]}
    assert shares == {
        **{"H >= 38": "1.39", "H >= 50": "1.39", "H >= 62": "0.00"},
        **{"H <= 58": "0.00", "H <= 70": "1.39", "H <= 82": "1.39"},
        **{"S >= 88": "1.39", "S >= 100": "1.39", "S >= 112": "1.39"},
        **{"V >= 88": "1.39", "V >= 100": "1.39", "V >= 112": "1.39"},
    }
    assert (tmp_path / "own.png").exists()


def test_a_bound_never_passes_the_other_end_of_its_range_nor_of_the_scale():
    frame = np.zeros((4, 4, 3), np.uint8)
    (lows, highs) = variations(frame, ColourRange(ColourSpace.HSV, (5, 0, 0), (15, 255, 255)), 20, 5)
    assert [variation.bound for variation in lows] == ["H >= 5", "H >= 15"]
    assert [variation.bound for variation in highs] == ["H <= 5", "H <= 15", "H <= 25", "H <= 35"]
    (lows, highs) = variations(frame, ColourRange(ColourSpace.HSV, (170, 0, 0), (5, 255, 255)), 5, 3)
    assert [variation.bound for variation in lows] == ["H >= 165", "H >= 170", "H >= 175"]
    assert [variation.bound for variation in highs] == ["H <= 0", "H <= 5", "H <= 10"]


@pytest.mark.parametrize(
    ("low", "what"), [("0,0,250", "no pixel has one of these colours"), ("0,0,0", "every pixel has one of these")]
)
def test_a_mask_that_is_all_or_nothing_is_a_warning_and_still_drawn(tmp_path, capsys, low, what):
    arguments = ("--low", low, "--high", "179,255,255")
    code, _, err = run(capsys, "--image", picture(tmp_path, colour=(1, 1, 1)), "--out", tmp_path / "out", *arguments)
    assert code == 0
    assert f"warning: own: {what}" in err
    assert (tmp_path / "out" / "own.png").exists()


def test_a_large_picture_is_scaled(tmp_path, capsys):
    path = picture(tmp_path, height=960, width=1280)
    assert read_picture(path, Console()).shape == (LONGEST_SIDE * 3 // 4, LONGEST_SIDE, 3)
    assert "1280x960 pixels, scaled to 640x480" in capsys.readouterr().out


@pytest.mark.parametrize("shape", [(1, 1), (90, 160), (120, 160), (640, 3), (3, 640), (480, 640)])
@pytest.mark.parametrize("columns", [3, 15])
def test_everything_has_room_on_the_sheet_whatever_the_pictures_shape(shape, columns):
    frame = np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8)
    colours = TARGET_COLOURS["create"]
    mask = colour_mask(frame, colours)
    rows = variations(frame, colours, 30, columns)
    sheet = draw_sheet(frame, "title", mask, rows, None)
    assert sheet.dtype == np.uint8
    assert sheet.shape[1] == GAP + max(4, columns) * (TILE_WIDTH + GAP)
    assert (sheet[:, -GAP // 2 :] == sheet[0, 0]).all()  # nothing runs over the edge
    assert (sheet[-GAP // 2 :] == sheet[0, 0]).all()


def test_the_large_mask_shows_as_much_as_there_is():
    frame = np.full((90, 160, 3), 128, np.uint8)
    frame[20:65, 40:120] = (255, 0, 0)  # a quarter of the picture
    sheet = draw_sheet(frame, "title", colour_mask(frame, TARGET_COLOURS["ur5"]), [], None)
    top, left = 3 * LABEL_HEIGHT + GAP, 2 * GAP + 2 * TILE_WIDTH
    large = sheet[top : sheet.shape[0] - GAP, left : left + 2 * TILE_WIDTH]
    assert (large == _INSIDE).all(axis=-1).mean() == pytest.approx(0.25, abs=0.02)  # the box's line is drawn over it


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (None, "cannot be read: No such file or directory"),
        (b"", "expected a picture that OpenCV can read"),
        (b"\x89PNG\r\n\x1a\nbroken", "expected a picture that OpenCV can read"),
    ],
)
def test_what_is_no_picture_is_named(tmp_path, capsys, content, match):
    path = tmp_path / "picture.png"
    if content is not None:
        path.write_bytes(content)
    code, out, err = run(capsys, "--image", path, "--out", tmp_path / "out")
    assert (code, out) == (1, "")
    assert f"tune: error: --image {path}: {match}" in err
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_written_is_named(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    out = tmp_path / "file" / "out"
    code, _, err = run(capsys, "--image", picture(tmp_path), "--out", out, "--robot", "vector")
    assert code == 1
    assert f"error: --out {out}: cannot be written to: Not a directory; choose another" in err


@pytest.mark.parametrize("output", ["full", "closed"])
def test_every_sheet_is_drawn_though_nobody_can_read_what_is_said(tmp_path, monkeypatch, output):
    with unusable_output(output) as stdout:
        monkeypatch.setattr("sys.stdout", stdout)
        assert main(["--image", str(picture(tmp_path, height=960, width=1280)), "--out", str(tmp_path / "out")]) == 0
    assert {path.stem for path in (tmp_path / "out").iterdir()} == set(TARGET_COLOURS)


def test_ctrl_c_leaves_whole_sheets_and_no_traceback(tmp_path, capsys, monkeypatch):
    robots = list(TARGET_COLOURS)

    def draw(frame, title, *others):
        if title.startswith(robots[1]):
            raise KeyboardInterrupt
        return draw_sheet(frame, title, *others)

    monkeypatch.setattr(tune, "draw_sheet", draw)
    code, out, err = run(capsys, "--image", picture(tmp_path), "--out", tmp_path / "out")
    assert (code, err) == (130, "")
    assert out.endswith("\ninterrupted\n")
    assert [path.name for path in (tmp_path / "out").iterdir()] == [f"{robots[0]}.png"]


def test_the_picture_itself_is_not_drawn_over(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    image = picture(tmp_path, name="create.png")
    content = image.read_bytes()
    code, out, err = run(capsys, "--image", "create.png", "--out", tmp_path)
    assert (code, out) == (1, "")
    assert f"error: --out {tmp_path}: {image} is the picture itself, --image; choose another" in err
    assert list(tmp_path.iterdir()) == [image]
    assert image.read_bytes() == content


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (["--low", "1,2,3"], "--low and --high: expected both or neither"),
        (["--low", "1,2", "--high", "3,4,5"], "--low 1,2: expected three whole numbers"),
        (["--low", "1,2,3", "--high", "a,4,5"], "--high a,4,5: expected three whole numbers"),
        (["--low", "1,2,3", "--high", "1,2,256"], "high = (1, 2, 256): expected H 0-179"),
        (["--low", "1,9,3", "--high", "1,2,3"], "S from 9 to 2: expected low <= high"),
        (["--low", "1,2,3", "--high", "3,4,5", "--robot", "ur5"], "expected robots' ranges or one of your own"),
        (["--space", "bgr"], "--space bgr: expected --low and --high with it"),
        (["--space", "hsv", "--robot", "ur5"], "--space hsv: expected --low and --high with it"),
    ],
)
def test_a_range_that_is_none_is_named(tmp_path, capsys, arguments, match):
    code, _, err = run(capsys, "--image", picture(tmp_path), "--out", tmp_path, *arguments)
    assert code == 1
    assert match in err


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (["--out", ""], "--out: expected a folder"),
        (["--columns", "4"], "odd number from 3 to 15"),
        (["--spread", "0"], "from 1 to 255"),
        (["--robot", "x"], "ur5"),
    ],
)
def test_a_wrong_option_is_named(tmp_path, capsys, arguments, match):
    with pytest.raises(SystemExit):
        main(["--image", "x", "--out", "y", *arguments])
    assert match in capsys.readouterr().err


def test_help_names_the_robots_ranges(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    assert "create  HSV  H 30-85  S 68-255  V 0-255" in capsys.readouterr().out
