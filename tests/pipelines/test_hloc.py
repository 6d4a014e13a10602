"""hloc's files: real h5, both orders of names, both layouts."""

from __future__ import annotations

import subprocess
import sys

import h5py
import numpy as np
import pytest
from pipeline_command import assert_one_line

from mgca_filter import MatchFilter, cli

NAMES = ["db/view.0.png", "db/view_1.png", "query/view-2.png", "query/view_3.png"]


def write_files(folder, views, matches, layout="{0}/{1}", turned=False, sift=True):
    """features.h5 and matches.h5 as hloc writes them."""
    with h5py.File(folder / "features.h5", "w") as file:
        for name, view in zip(NAMES, views):
            group = file.create_group(name)
            group["keypoints"] = view.points.astype(np.float32)
            group["image_size"] = np.array(view.image.shape[1::-1])
            group["descriptors"] = view.descriptors.T.astype(np.float16)
            if sift:
                group["scales"] = np.array([k.size / 2 for k in view.keypoints], np.float32)
                group["oris"] = np.array([k.angle for k in view.keypoints], np.float32)
    with h5py.File(folder / "matches.h5", "w") as file:
        for (i, j), pairs in matches.items():
            first, second = (j, i) if turned else (i, j)
            columns = pairs[:, ::-1] if turned else pairs
            partner = np.full(len(views[first].points), -1, np.int32)
            partner[columns[:, 0]] = columns[:, 1]
            group = file.create_group(layout.format(*(NAMES[k].replace("/", "-") for k in (first, second))))
            group.attrs["note"] = "kept"
            group["matches0"] = partner
            group["matching_scores0"] = np.linspace(0.1, 1.0, len(partner)).astype(np.float16)
    return folder / "features.h5", folder / "matches.h5"


def run(features, matches, output, *words) -> int:
    return cli.main(["hloc", str(features), str(matches), "-o", str(output), *words])


def contents(path) -> dict[str, np.ndarray]:
    found = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None)
    return found


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("layout", ["{0}/{1}", "{0}_{1}"])
def test_wrong_matches_go_and_everything_else_stays(tmp_path, views, raw_matches, layout, turned, capsys):
    three = {pair: raw_matches[pair] for pair in ((0, 1), (0, 3), (1, 2))}
    features, matches = write_files(tmp_path, views, three, layout, turned)
    before = matches.read_bytes()
    assert run(features, matches, tmp_path / "filtered.h5") == 0
    assert "3 pairs" in capsys.readouterr().out
    assert matches.read_bytes() == before
    given, filtered = contents(matches), contents(tmp_path / "filtered.h5")
    assert list(given) == list(filtered)
    for name in (name for name in given if name.endswith("matches0")):
        kept = filtered[name] > -1
        assert 30 < kept.sum() < 0.5 * (given[name] > -1).sum()
        assert np.array_equal(filtered[name][kept], given[name][kept])
        scores = name.replace("matches0", "matching_scores0")
        assert np.array_equal(filtered[scores], np.where(kept, given[scores], 0))
        assert filtered[name].dtype == given[name].dtype
    with h5py.File(tmp_path / "filtered.h5") as file:
        assert next(item.parent.attrs["note"] for item in walk(file)) == "kept"


def walk(file):
    found = []
    file.visititems(lambda name, item: found.append(item) if isinstance(item, h5py.Dataset) else None)
    return found


def test_the_filter_sees_the_files_as_they_are(tmp_path, views, raw_matches):
    """Points and the image's size: the same rows as ``MatchFilter``."""
    features, matches = write_files(tmp_path, views, {(0, 1): raw_matches[0, 1]}, sift=False)
    assert run(features, matches, tmp_path / "filtered.h5", "-q", "--threshold", "2") == 0
    size = views[0].image.shape[1::-1]
    with h5py.File(tmp_path / "filtered.h5") as file:
        kept = file[NAMES[0].replace("/", "-")][NAMES[1].replace("/", "-")]["matches0"][()] > -1
    rows = raw_matches[0, 1][np.argsort(raw_matches[0, 1][:, 0])]
    points = [view.points.astype(np.float32) for view in views]
    result = MatchFilter(threshold=2.0).filter(points[0], points[1], rows, size1=size, size2=size)
    assert np.array_equal(np.flatnonzero(kept), rows[result.mask, 0])


def test_descriptors_are_used_unless_forbidden(tmp_path, views, raw_matches):
    features, matches = write_files(tmp_path, views, {(0, 1): raw_matches[0, 1]})
    assert run(features, matches, tmp_path / "with.h5", "-q") == 0
    assert run(features, matches, tmp_path / "without.h5", "-q", "--no-descriptors") == 0
    first, second = contents(tmp_path / "with.h5"), contents(tmp_path / "without.h5")
    assert any(not np.array_equal(first[name], second[name]) for name in first)


def test_misuse_is_one_line(tmp_path, views, raw_matches, capsys):
    features, matches = write_files(tmp_path, views, {(0, 1): raw_matches[0, 1]})
    (tmp_path / "broken.h5").write_bytes(matches.read_bytes()[:300])
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["a.jpg/b.jpg/matches0"] = np.zeros(3, np.int32)
    for given, words in (
        ((features, tmp_path / "missing.h5", tmp_path / "o.h5"), ["missing.h5", "no such file"]),
        ((features, tmp_path / "broken.h5", tmp_path / "o.h5"), ["broken.h5"]),
        ((features, tmp_path / "other.h5", tmp_path / "o.h5"), ["other.h5: a.jpg/b.jpg", "not in", "features.h5"]),
        ((features, matches, matches), ["is the input"]),
    ):
        assert run(*given) == 2
        assert_one_line(capsys.readouterr(), *words)


def test_file_that_another_process_writes(tmp_path, views, raw_matches, capsys):
    features, matches = write_files(tmp_path, views, {(0, 1): raw_matches[0, 1]})
    program = "import h5py, sys; f = h5py.File(sys.argv[1], 'r+'); print('open', flush=True); sys.stdin.read()"
    command = [sys.executable, "-c", program, str(matches)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"open\n"
        assert run(features, matches, tmp_path / "o.h5", "-q") == 2
        other.stdin.close()
    assert_one_line(capsys.readouterr(), "matches.h5", "locked by another process")


@pytest.mark.parametrize("defect", ["shape", "index", "checksum"])
def test_a_damaged_dataset_costs_its_own_pairs_only(tmp_path, views, raw_matches, capsys, defect):
    features, matches = write_files(tmp_path, views[:3], {pair: raw_matches[pair] for pair in ((0, 1), (1, 2))})
    with h5py.File(features, "r+") as file:
        points = file[NAMES[2]]["keypoints"][()]
        if defect != "index":
            del file[NAMES[2]]["keypoints"]
        if defect == "shape":
            file[NAMES[2]]["keypoints"] = points.ravel()
        elif defect == "checksum":
            file[NAMES[2]].create_dataset("keypoints", data=points, fletcher32=True)
            start = file[NAMES[2]]["keypoints"].id.get_chunk_info(0).byte_offset
    if defect == "checksum":
        data = bytearray(features.read_bytes())
        data[start] ^= 1
        features.write_bytes(data)
    if defect == "index":
        with h5py.File(matches, "r+") as file:
            group = file[NAMES[1].replace("/", "-")][NAMES[2].replace("/", "-")]
            group["matches0"][...] = 99999
    assert run(features, matches, tmp_path / "out.h5", "-q") == 0
    assert_one_line(capsys.readouterr(), NAMES[2])
    kept = {name: (values > -1).any() for name, values in contents(tmp_path / "out.h5").items() if "matches0" in name}
    assert sorted(kept.values()) == [False, True]


def test_half_precision_loses_no_matches(tmp_path, views, raw_matches):
    """hloc can store keypoints as float16, good to a quarter of a pixel at 640."""
    counts = {}
    for dtype in (np.float16, np.float32):
        folder = tmp_path / np.dtype(dtype).name
        folder.mkdir()
        features, matches = write_files(folder, views, {(0, 1): raw_matches[0, 1]})
        with h5py.File(features, "r+") as file:
            for name in NAMES[:2]:
                points = file[name]["keypoints"][()].astype(dtype)
                del file[name]["keypoints"]
                file[name]["keypoints"] = points
        assert run(features, matches, folder / "filtered.h5", "-q") == 0
        with h5py.File(folder / "filtered.h5") as file:
            group = file[NAMES[0].replace("/", "-")][NAMES[1].replace("/", "-")]
            counts[dtype] = np.count_nonzero(group["matches0"][()] > -1)
    assert counts[np.float16] > 0.9 * counts[np.float32] > 50
