"""``mgca-match``: exit status, what goes to which stream, files written, one-line errors."""

import dataclasses
import json
import os
import re
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from exif_files import FOCAL_35MM, with_exif
from image_files import turned

import mgca_filter
from mgca_filter import cli
from mgca_filter.geometry.epipolar import pose_error_deg, sampson_distance

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "examples" / "images"
LEFT, RIGHT = str(IMAGES / "left.jpg"), str(IMAGES / "right.jpg")
K_WORDS = "820,820,511.5,383.5"
JSON_KEYS = {
    "version", "image1", "image2", "status", "confidence", "verified", "num_matches", "num_inliers",
    "E", "F", "R", "t", "H",
    "K1", "K2", "dist1", "dist2", "homography", "intrinsics", "focal_px", "assumptions", "backend", "model",
    "model_sha256", "networks", "timings_ms", "kept",
}  # fmt: skip
JUDGED = ("rotation_error_deg", "translation_error_deg", "num_inliers_right")


def run_command(*arguments: str) -> subprocess.CompletedProcess:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "mgca_filter", *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=environment)


@pytest.fixture(scope="module")
def outputs(tmp_path_factory, model_file):
    """One full run on the example pair: folder with the files, and the finished process."""
    folder = tmp_path_factory.mktemp("outputs")
    options = ["--model", str(model_file), "--max-keypoints", "2000", "--compare"]
    files = ["-o", str(folder / "m.png"), "--npz", str(folder / "m.data"), "--json", "-"]
    files += ["--truth", str(IMAGES / "pair.json"), "--html", str(folder / "m.html")]
    done = run_command(LEFT, RIGHT, "--K", K_WORDS, *options, *files)
    assert done.returncode == 0, done.stderr
    return folder, done


@pytest.fixture(scope="module")
def document(outputs) -> dict:
    return json.loads(outputs[1].stdout)


@pytest.fixture
def unrelated(tmp_path) -> str:
    """An image file of noise."""
    path = tmp_path / "noise.png"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (120, 160), dtype=np.uint8))
    return str(path)


def assert_usage_error(capsys, arguments: list[str], *words: str) -> None:
    """Exit status 2, nothing on stdout, one line on stderr with all the words."""
    assert cli.main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1, err
    assert err.startswith("mgca-match: ")
    for word in words:
        assert word in err


def test_shipped_model_finds_the_exact_pose(tmp_path):
    """What the README's first command does."""
    done = run_command(LEFT, RIGHT, "--K", K_WORDS, "--json", str(tmp_path / "pair.json"))
    assert done.returncode == 0, done.stderr
    assert "status ok" in done.stdout
    found = json.loads((tmp_path / "pair.json").read_text())
    truth = json.loads((IMAGES / "pair.json").read_text())
    assert pose_error_deg(found["R"], found["t"], truth["R"], truth["t"]) < 2.0


def test_json_has_every_key_and_agrees_with_itself(document):
    assert set(document) == JSON_KEYS | {"comparison", "truth"}
    assert document["version"] == mgca_filter.__version__
    assert document["status"] == "ok"
    assert document["intrinsics"] == "given"
    assert document["image1"]["width"] == 1024
    assert document["image2"]["height"] == 768
    assert document["num_matches"] == document["image1"]["num_keypoints"]
    kept = document["kept"]
    assert {len(values) for values in kept.values()} == {document["num_inliers"]}
    points = np.hstack([kept["points1"], kept["points2"]])
    assert sampson_distance(points, document["F"]).max() < 1.1
    np.testing.assert_array_equal(document["K1"], [[820, 0, 511.5], [0, 820, 383.5], [0, 0, 1]])


def test_summary_and_table_go_to_stderr_when_json_has_stdout(outputs, document):
    summary = outputs[1].stderr
    assert f"{document['num_matches']} matches in, {document['num_inliers']} kept" in summary
    for name in ("mgca_filter", "RANSAC", "MAGSAC"):
        assert any(line.startswith(name) for line in summary.splitlines())
    assert "error" not in summary


def test_comparison_is_on_the_same_matches(document):
    for fit in document["comparison"]:
        assert set(fit) == {"name", "num_inliers", "E", "R", "t", "fit_ms", *JUDGED}
        assert 0 < fit["num_inliers"] <= document["num_matches"]
        np.testing.assert_allclose(np.linalg.det(fit["R"]), 1.0, atol=1e-9)
    assert [fit["name"] for fit in document["comparison"]] == ["RANSAC", "MAGSAC"]


def test_npz_keeps_its_name_and_holds_the_same_answer(outputs, document):
    with np.load(outputs[0] / "m.data", allow_pickle=False) as arrays:
        count = document["num_matches"]
        assert arrays["points1"].shape == arrays["points2"].shape == arrays["indices"].shape == (count, 2)
        assert arrays["scores"].shape == arrays["mask"].shape == (count,)
        assert arrays["scores"].dtype == np.float32
        assert arrays["mask"].sum() == document["num_inliers"]
        assert str(arrays["status"]) == "ok"
        for name in ("E", "F", "R", "t", "K1", "K2"):
            np.testing.assert_allclose(arrays[name], document[name], rtol=1e-8)
        np.testing.assert_allclose(arrays["points1"][arrays["mask"]], document["kept"]["points1"], atol=5.1e-4)


def numbers_of(value) -> list[float]:
    if isinstance(value, dict):
        return numbers_of(list(value.values()))
    return [n for item in value for n in numbers_of(item)] if isinstance(value, list) else [value]


def test_numbers_of_the_json_are_rounded(outputs, document):
    places = [(document["kept"]["points1"], 3), (document["kept"]["scores"], 4), (document["timings_ms"], 2)]
    for values, digits in [*places, (document["confidence"], 4)]:
        assert all(value == round(value, digits) for value in numbers_of([values]))
    for name in ("E", "F", "R"):
        assert all(value == float(f"{value:.9g}") for value in numbers_of(document[name]))
    assert len(outputs[1].stdout) < 130 * document["num_inliers"] + 6000


def test_the_page_on_the_json_lists_every_key(document):
    page = (ROOT / "docs" / "reference" / "command-line-output.md").read_text(encoding="utf-8")
    pair, _, rest = page.partition("## `mgca-match img1 img2 --json`")[2].partition("\n## ")
    assert "mgca-match folder" in rest
    rows = re.findall(r"^\| (`.*?) \|", pair, re.MULTILINE)
    listed = {key for row in rows for key in re.findall(r"`([^`]+)`", row)}

    def keys(value, prefix=""):
        for key, item in value.items():
            yield prefix + key
            inner = item[0] if isinstance(item, list) and item and isinstance(item[0], dict) else item
            if isinstance(inner, dict) and key != "timings_ms":
                yield from keys(inner, f"{prefix}{key}.")

    assert listed == set(keys(document))


def test_truth_tells_who_is_right(outputs, document):
    truth = document["truth"]
    assert truth["rotation_error_deg"] < 1
    assert truth["num_inliers_right"] <= truth["num_right"]
    assert truth["num_inliers_right"] > 0.9 * document["num_inliers"]
    errors = [fit["translation_error_deg"] for fit in document["comparison"]]
    assert min(errors) >= 0
    lines = outputs[1].stderr.splitlines()
    told = f"{truth['num_inliers_right']} of {document['num_inliers']} kept matches right, {truth['num_right']} of all"
    assert any(line.startswith("against the truth: rotation off by") and line.endswith(told) for line in lines)
    head = next(line for line in lines if "rotation off" in line and "kept" in line and "right" in line)
    assert "translation off" in head
    assert '"true_F": [[' in (outputs[0] / "m.html").read_text() or '"true_F":[[' in (outputs[0] / "m.html").read_text()


def test_picture_is_written(outputs):
    picture = cv2.imread(str(outputs[0] / "m.png"))
    assert picture.shape[1] == 1600


def test_the_overlay_shows_image_1_on_image_2(tmp_path, model_file, caplog):
    """A photograph and itself, warped: the overlay is the second where the first reaches."""
    photo = cv2.imread(LEFT)
    height, width = photo.shape[:2]
    H = np.array([[0.9, 0.05, 30], [-0.04, 0.92, 25], [1e-5, 2e-5, 1]])
    other = cv2.warpPerspective(photo, H, (width, height))
    cv2.imwrite(str(tmp_path / "other.png"), other)
    words = ["--model", str(model_file), "--max-keypoints", "300", "-q", "--overlay", str(tmp_path / "over.png")]
    assert cli.main([LEFT, str(tmp_path / "other.png"), *words, "--geometry", "homography"]) == 0
    over = cv2.imread(str(tmp_path / "over.png"))
    assert over.shape == other.shape
    assert np.abs(over[150:-150, 150:-150].astype(int) - other[150:-150, 150:-150]).mean() < 3.0
    (tmp_path / "over.png").unlink()
    words.remove("-q")
    assert cli.main([LEFT, RIGHT, *words, "--K", K_WORDS]) == 0
    assert not (tmp_path / "over.png").exists()
    assert "no homography was found" in caplog.text
    assert cli.main([LEFT, RIGHT, "--overlay", str(tmp_path / "over.xyz")]) == 2


def test_no_geometry_exits_with_1_and_still_writes(tmp_path, unrelated, model_file, capsys):
    files = ["-o", str(tmp_path / "m.png"), "--npz", str(tmp_path / "m.npz"), "--json", str(tmp_path / "m.json")]
    status = cli.main([LEFT, unrelated, "--model", str(model_file), "--max-keypoints", "300", "--compare", *files])
    assert status == 1
    found = json.loads((tmp_path / "m.json").read_text())
    assert found["num_inliers"] == len(found["kept"]["scores"])
    assert found["intrinsics"] == "guessed"
    assert "status " + found["status"] in capsys.readouterr().out
    assert cv2.imread(str(tmp_path / "m.png")) is not None
    with np.load(tmp_path / "m.npz") as arrays:
        assert set(arrays.files) >= {"points1", "points2", "scores", "mask"}


def test_images_without_a_keypoint_exit_with_1(tmp_path, model_file, capsys):
    path = tmp_path / "flat.png"
    cv2.imwrite(str(path), np.full((40, 60), 128, np.uint8))
    files = ["-o", str(tmp_path / "m.png"), "--npz", str(tmp_path / "m.npz")]
    assert cli.main([str(path), str(path), "--model", str(model_file), "--compare", *files]) == 1
    assert "0 matches in, 0 kept, status too_few_matches" in capsys.readouterr().out


def test_quiet_says_nothing(unrelated, model_file, capsys):
    cli.main([unrelated, unrelated, "--model", str(model_file), "--max-keypoints", "50", "-q"])
    assert capsys.readouterr() == ("", "")


def test_verbose_logs_on_stderr(unrelated, model_file, capsys):
    cli.main([unrelated, unrelated, "--model", str(model_file), "--max-keypoints", "50", "-v"])
    assert "guessed" in capsys.readouterr().err


def test_same_seed_same_bytes(unrelated, model_file, tmp_path):
    arguments = [unrelated, unrelated, "--model", str(model_file), "--max-keypoints", "100", "-q"]
    for name in ("a.npz", "b.npz"):
        cli.main([*arguments, "--npz", str(tmp_path / name)])
    with np.load(tmp_path / "a.npz") as first, np.load(tmp_path / "b.npz") as second:
        assert all(np.array_equal(first[name], second[name]) for name in first.files)


K_A, K_B = np.array([[5.0, 0, 3], [0, 6, 4], [0, 0, 1]]), np.array([[7.0, 0, 1], [0, 8, 2], [0, 0, 1]])


@pytest.fixture
def seen(monkeypatch) -> dict:
    """Options that reach the filter; no pair is matched."""
    options_seen = {}

    def record(image1, image2, **options):
        options_seen.update(options)
        raise ValueError("seen enough")

    monkeypatch.setattr("mgca_filter.cli.pair.match_images", record)
    return options_seen


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], {"detector": "rootsift", "max_keypoints": 4000, "threshold": 1.0, "method": "auto", "seed": 0}),
        ([], {"K1": None, "K2": None, "model": None, "providers": None}),
        (["--detector", "orb"], {"detector": "orb"}),
        (["--detector", "sift"], {"detector": "sift"}),
        (["--detector", "brisk"], {"detector": "brisk"}),
        (["--max-keypoints", "77"], {"max_keypoints": 77}),
        (["--threshold", "2.5"], {"threshold": 2.5}),
        (["--keep-precision", "0.9"], {"keep_precision": 0.9}),
        (["--method", "magsac"], {"method": "magsac"}),
        (["--model", "m.onnx"], {"model": "m.onnx"}),
        (["--providers", "cpu"], {"providers": ["CPUExecutionProvider"]}),
        (["--providers", "NoSuch,CPUExecutionProvider"], {"providers": ["NoSuch", "CPUExecutionProvider"]}),
        (["--K", K_WORDS, "--dist", "0.1,0,0,0"], {"dist1": [0.1, 0, 0, 0], "dist2": None}),
        (["--K", K_WORDS, "--dist2", "0.1,0,0,0"], {"dist1": None, "dist2": [0.1, 0, 0, 0]}),
        (["--K", K_WORDS, "--dist", "0.1,0,0,0", "--dist1", "0.2,0,0,0"], {"dist1": [0.2, 0, 0, 0]}),
        (["--seed", "9"], {"seed": 9}),
        (["--K", "5,6,3,4"], {"K1": K_A, "K2": None}),
        (["--K1", "5,6,3,4", "--K2", "7,8,1,2"], {"K1": K_A, "K2": K_B}),
    ],
)
def test_every_option_reaches_the_filter(seen, words, expected):
    assert cli.main([LEFT, RIGHT, *words]) == 2
    for name, value in expected.items():
        np.testing.assert_array_equal(seen[name], value, err_msg=name)


@pytest.mark.parametrize(
    "words",
    ["820,820,511.5", "a,b,c,d", "0,820,1,1", "820,-1,1,1", "nan,820,1,1", "820,820,inf,1", ""],
)
def test_wrong_intrinsics(capsys, words):
    assert_usage_error(capsys, [LEFT, RIGHT, f"--K={words}"], "--K", "fx,fy,cx,cy" if "," not in words else "expected")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["img1"]),
        ([LEFT], ["img2"]),
        ([LEFT, RIGHT, "--nonsense"], ["--nonsense"]),
        ([LEFT, RIGHT, "--K1", K_WORDS], ["--K2"]),
        ([LEFT, RIGHT, "--K", K_WORDS, "--K1", K_WORDS, "--K2", K_WORDS], ["excludes"]),
        ([LEFT, RIGHT, "--dist", "0.1,0,0,0"], ["--dist", "needs --K"]),
        ([LEFT, RIGHT, "--K", "no/such/K.txt"], ["no/such/K.txt", "no such file"]),
        ([LEFT, RIGHT, "--truth", "no/such/pose.txt"], ["no/such/pose.txt", "no such file"]),
        ([LEFT, RIGHT, "--truth", LEFT], ["left.jpg", "not a text file"]),
        ([LEFT, RIGHT, "--providers", "abacus"], ["abacus", "CPUExecutionProvider"]),
        ([LEFT, RIGHT, "--detector", "surf"], ["--detector", "surf"]),
        ([LEFT, RIGHT, "--threshold", "0"], ["--threshold"]),
        ([LEFT, RIGHT, "--threshold", "nan"], ["--threshold"]),
        ([LEFT, RIGHT, "--keep-precision", "1.5"], ["keep_precision", "below 1"]),
        ([LEFT, RIGHT, "--max-keypoints", "-3"], ["--max-keypoints"]),
        ([LEFT, RIGHT, "--method", "lmeds"], ["--method"]),
        ([LEFT, RIGHT, "--seed", "x"], ["--seed"]),
        ([LEFT, RIGHT, "--seed", "-1"], ["seed"]),
        ([LEFT, RIGHT, "--model", "missing.onnx"], ["missing.onnx"]),
        ([LEFT, "missing.png"], ["missing.png", "No such file"]),
        ([str(IMAGES), RIGHT], [str(IMAGES)]),
        ([LEFT, str(IMAGES / "pair.json")], ["pair.json"]),
        ([LEFT, RIGHT, "-o", "no/such/folder/m.png"], ["no/such/folder/m.png"]),
        ([LEFT, RIGHT, "-o", "m.nonsense"], ["m.nonsense"]),
        ([LEFT, RIGHT, "-o", "without_suffix"], ["without_suffix: ", ".png"]),
        ([LEFT, RIGHT, "-o", LEFT], ["left.jpg", "is one of the images"]),
        ([LEFT, RIGHT, "--npz", RIGHT], ["right.jpg", "is one of the images"]),
        ([LEFT, RIGHT, "--json", str(IMAGES)], [str(IMAGES)]),
        ([LEFT, RIGHT, "--json", "x.out", "--npz", "./x.out"], ["x.out", "twice"]),
        ([LEFT, "/dev/null"], ["/dev/null", "empty"]),
        ([LEFT, RIGHT, "--npz", "no/such/folder/m.npz"], ["no/such/folder/m.npz"]),
    ],
)
def test_misuse_is_one_line_that_names_it(capsys, arguments, words):
    assert_usage_error(capsys, arguments, *words)


@pytest.fixture
def photographs(tmp_path) -> list[str]:
    """The example pair with the focal length in its EXIF data: 28 mm are 819 px; true are 820."""
    paths = [tmp_path / "left.jpg", tmp_path / "right.jpg"]
    for path, source in zip(paths, (LEFT, RIGHT)):
        path.write_bytes(with_exif(Path(source).read_bytes(), {FOCAL_35MM: 28}))
    return [str(path) for path in paths]


def test_the_focal_length_is_that_of_the_exif_data(photographs, capsys):
    def found(*words: str) -> dict:
        assert cli.main([*photographs, "--json", "-", *words]) == 0
        return json.loads(capsys.readouterr().out)

    exif = found("-q")
    assert exif["intrinsics"] == "exif"
    focal = 28 / 35 * 1024
    np.testing.assert_allclose(exif["K1"], [[focal, 0, 511.5], [0, focal, 383.5], [0, 0, 1]])
    truth = json.loads((IMAGES / "pair.json").read_text())
    assert pose_error_deg(exif["R"], exif["t"], truth["R"], truth["t"]) < 2.0
    few = ("--max-keypoints", "500")
    assert found("-q", "--no-exif", *few)["intrinsics"] in ("estimated", "guessed")
    assert found("-q", "--K", K_WORDS, *few)["intrinsics"] == "given"
    assert cli.main([*photographs, *few]) == 0
    assert "focal lengths 819 and 819 px, from EXIF data" in capsys.readouterr().out


def test_exif_data_of_one_photograph_are_no_pair_of_cameras(photographs, capsys):
    assert cli.main([photographs[0], RIGHT, "-q", "--max-keypoints", "500", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["intrinsics"] in ("estimated", "guessed")


def test_exif_data_that_the_matches_contradict_are_left(photographs, monkeypatch, capsys):
    from mgca_filter.cli import pair

    def match(*images, **options):
        matched = mgca_filter.match_images(*images, **options)
        suspicious = dataclasses.replace(matched.result, status=mgca_filter.Status.SUSPICIOUS_INTRINSICS)
        return matched if options.get("K1") is None else dataclasses.replace(matched, result=suspicious)

    monkeypatch.setattr(pair, "match_images", match)
    assert cli.main([*photographs, "--max-keypoints", "500", "--json", "-"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["intrinsics"] in ("estimated", "guessed")
    assert "the matches contradict the focal length of the EXIF data" in err


def test_one_K_of_a_camera_that_was_turned_fits_both_photos(seen, tmp_path):
    """Held upright and sideways: K as stored is turned with the photo, as by folder."""
    stored = cv2.rotate(cv2.imread(RIGHT), cv2.ROTATE_90_COUNTERCLOCKWISE)
    (tmp_path / "flat.png").write_bytes(turned(".png", cv2.imread(RIGHT), 6))  # shown as 768 x 1024
    (tmp_path / "upright.png").write_bytes(turned(".png", stored, 6))  # shown as 1024 x 768
    for name, K2 in (("upright.png", None), ("flat.png", [[820, 0, 383.5], [0, 820, 511.5], [0, 0, 1]])):
        assert cli.main([LEFT, str(tmp_path / name), "--K", K_WORDS]) == 2
        np.testing.assert_array_equal(seen["K1"], [[820, 0, 511.5], [0, 820, 383.5], [0, 0, 1]])
        np.testing.assert_array_equal(seen["K2"], K2)


def test_a_camera_of_another_size_is_refused(tmp_path, capsys):
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 2048 1536 1640 1640 1024 768\n")
    words = [LEFT, RIGHT, "--K", str(tmp_path / "cameras.txt")]
    assert_usage_error(capsys, words, "2048 x 1536", "left.jpg has 1024 x 768", "K is 820,820,511.5,383.5")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--threshold", "1e-3"], "--threshold 0.001 is in pixels"),
        (["--threshold", "50"], "--threshold 50 is in pixels"),
        (["--keep-precision", "0.5", "--threshold", "2"], "--threshold has no say"),
        (["--max-keypoints", "20"], "too few"),
        (["--no-exif", "--K", K_WORDS], "--no-exif has no say"),
    ],
)
def test_options_that_make_no_sense_are_told(seen, capsys, words, told):
    cli.main([LEFT, RIGHT, *words])
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("mgca-match: warning: ")
    assert told in lines[0]
    assert len(lines) == 2  # the other one is of the fixture
    cli.main([LEFT, RIGHT, *words, "-q"])
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_options_that_make_sense_are_not(seen, capsys):
    for words in ([], ["--threshold", "0.3"], ["--keep-precision", "0.9"], ["--K", K_WORDS], ["--no-exif"]):
        cli.main([LEFT, RIGHT, *words])
        assert "warning" not in capsys.readouterr().err


def test_K_in_millimetres_is_told(unrelated, model_file, capsys):
    cli.main([unrelated, unrelated, "--model", str(model_file), "--K", "4.2,4.2,2,1.5", "--max-keypoints", "150"])
    err = capsys.readouterr().err
    assert "a focal length of 4.2 px is that of no lens for an image of 160 x 120" in err


def test_a_guessed_focal_length_is_told_with_what_to_do(unrelated, model_file, capsys):
    cli.main([LEFT, unrelated, "--model", str(model_file), "--max-keypoints", "150"])
    out = capsys.readouterr().out
    assert "focal length 1229 and 192 px guessed" in out
    assert "give --K fx,fy,cx,cy or --K FILE" in out


def test_providers_are_listed(capsys):
    with pytest.raises(SystemExit) as stopped:
        cli.main([LEFT, RIGHT, "--providers", "list"])
    assert stopped.value.code == 0
    assert "CPUExecutionProvider" in capsys.readouterr().out.splitlines()


def test_empty_file_is_named(capsys, tmp_path):
    (tmp_path / "empty.png").touch()
    assert_usage_error(capsys, [LEFT, str(tmp_path / "empty.png")], "empty.png")


def test_image_too_large_to_decode_is_named(tmp_path):
    """A PNG whose header promises 100 000 x 100 000 pixels; a real process, for the codecs write to stderr too."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 100_000, 100_000, 8, 0, 0, 0, 0))
    path = tmp_path / "huge.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"\0" * 10)) + chunk(b"IEND", b""))
    done = run_command(LEFT, str(path))
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert "huge.png" in done.stderr


def test_version_and_help(capsys):
    for option, words in (("--version", mgca_filter.__version__), ("--help", "exit status")):
        with pytest.raises(SystemExit) as stopped:
            cli.main([option])
        assert stopped.value.code == 0
        assert words in capsys.readouterr().out


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
@pytest.mark.parametrize("option", ["--json", "--npz", "--html"])
def test_a_full_disk_is_told_with_the_file(unrelated, model_file, capsys, tmp_path, option):
    """By a link to the device, so that no fault of ours can replace the device itself."""
    (tmp_path / "full").symlink_to("/dev/full")
    path = str(tmp_path / "full")
    words = [unrelated, unrelated, "--model", str(model_file), "--max-keypoints", "150", "-q", option, path]
    assert cli.main(words) == 2
    assert capsys.readouterr().err == f"mgca-match: {path}: No space left on device\n"


def test_an_image_that_never_ends_is_not_read_to_its_end(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("mgca_filter.cli.pair.MAX_FILE_BYTES", 2_000_000)
    assert_usage_error(capsys, [LEFT, "/dev/zero"], "/dev/zero", "longer than")
    (tmp_path / "sparse.png").touch()
    os.truncate(tmp_path / "sparse.png", 2**40)
    assert_usage_error(capsys, [LEFT, str(tmp_path / "sparse.png")], "sparse.png", "longer than")


def test_names_that_the_terminal_cannot_show_are_shown_all_the_same(tmp_path, model_file, unrelated):
    path = tmp_path / "b\u00fcro.png"
    path.write_bytes(Path(unrelated).read_bytes())
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONIOENCODING": "ascii"}
    command = [sys.executable, "-m", "mgca_filter", str(path), str(path), "--model", str(model_file)]
    done = subprocess.run([*command, "--max-keypoints", "150"], capture_output=True, text=True, env=environment)
    assert "b\\xfcro.png: 160 x 120" in done.stdout, done.stderr
