"""The comparison with the peer's step, against a double: a few lines with the names and files of the real checkout.

The double checks what it is given as the peer would read it; it is not the peer, and says nothing of its speed.
"""

from __future__ import annotations

import json
from pathlib import Path

import peer_step
import pytest

DOUBLE = """
import os, pickle, time
import cv2, joblib, numpy as np, torch

tqdm = None
MAX_STEPS = 4001


def load(root, index):
    color = cv2.imread(f"{root}/raw_colors/{index:05d}_raw_color.png")[..., ::-1] / 255.0
    mask = cv2.imread(f"{root}/{index:05d}_mask.png", cv2.IMREAD_UNCHANGED) / 255.0
    uv, depth = (np.load(f"{root}/{index:05d}_{name}.npz")["arr_0"] for name in ("uv", "depth"))
    K = np.loadtxt(f"{root}/{index:05d}_intrinsic.txt")
    return color, mask, uv, depth, K, np.loadtxt(f"{root}/{index:05d}_pose.txt")


def train(args):
    root = args.input_dir
    pairs = pickle.load(open(os.path.join(root, "pose_pair.pkl"), "rb"))
    offsets = joblib.load(os.path.join(root, "offset_dict.p"))
    assert all(tuple(offsets[index]) == (0, 0) for index in range(len(pairs)))
    assert args.use_mislaign_offset == 1 and args.n_patches_h == args.n_patches_w == 1
    texture = cv2.imread(os.path.join(root, "shape/mtl0.png"))[..., ::-1] / 255.0
    bar = tqdm.tqdm(total=MAX_STEPS)
    for step in range(MAX_STEPS):
        bar.update()
        time.sleep(0.02)
    for index, others in enumerate(pairs):
        assert others.count(index) == 1  # as its converter has it; its dataset adds it once more
        color, mask, uv, depth, K, world2cam = load(root, index)
        assert color.shape == (*mask.shape, 3) and uv.shape == (*mask.shape, 2) and 0 <= uv.min() <= uv.max() <= 1
        assert ((mask > 0) == (depth > 0)).all() and 0.1 < mask.mean() < 1
        # v counts from below, and the corners' texels are at 0 and 1: the start shows about what the photograph does.
        uv[..., 1] = 1 - uv[..., 1]
        x, y = (uv.astype("float32") * (np.array(texture.shape[1::-1], "float32") - 1)).transpose(2, 0, 1)
        shown = cv2.remap(texture.astype("float32"), x, y, cv2.INTER_LINEAR)
        assert np.abs(shown - color)[mask > 0].mean() < 0.03, np.abs(shown - color)[mask > 0].mean()
        for other in others:
            # The peer's reprojection, with whole numbers for pixel centers: what both see is seen at the same depth.
            _, _, _, depth_there, K_there, world2cam_there = load(root, other)
            yy, xx = np.mgrid[: mask.shape[0], : mask.shape[1]]
            xyz = np.stack(((xx - K[0, 2]) / K[0, 0] * depth, (yy - K[1, 2]) / K[1, 1] * depth, depth, 1 + 0 * depth))
            there = np.einsum("ij,jhw->ihw", world2cam_there @ np.linalg.inv(world2cam), xyz)
            column = np.rint(there[0] / (1e-8 + there[2]) * K_there[0, 0] + K_there[0, 2]).astype(int)
            row = np.rint(there[1] / (1e-8 + there[2]) * K_there[1, 1] + K_there[1, 2]).astype(int)
            inside = (depth > 0) & (column >= 0) & (row >= 0) & (column < mask.shape[1]) & (row < mask.shape[0])
            difference = np.abs(depth_there[row[inside], column[inside]] - there[2][inside])
            assert np.median(difference) < 0.01, np.median(difference)
    assert any(pairs)
    cv2.imwrite(os.path.join(args.output_dir, "shape/mtl0.png"), texture)
"""
JOBLIB = """
import json


def dump(value, path):
    with open(path, "w") as file:
        json.dump(list(value.items()), file)


def load(path):
    with open(path) as file:
        return dict(json.load(file))
"""
SMALL = ["--size", "96x72", "--views", "16", "--faces", "600", "--warmup", "2", "--steps", "3", "--device", "cpu"]


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    for name in peer_step.NEEDED:
        file = tmp_path / "checkout" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(DOUBLE if file.stem == "optim_patch_torch" else "")
    (tmp_path / "checkout" / "joblib.py").write_text(JOBLIB)
    return tmp_path / "checkout"


def test_both_take_steps_on_the_same_views(
    checkout: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("advtex_engine.bench.run.STEPS", 1)
    monkeypatch.setattr("advtex_engine.bench.run.WARMUP", 1)
    monkeypatch.setattr("advtex_engine.bench.run.LAUNCHES", 1)
    status = peer_step.main([str(checkout), *SMALL, "--json"])
    told = capsys.readouterr()
    assert status == 0, told.err
    result = json.loads(told.out)
    assert (result["device"], result["size"], result["views"]) == ("cpu", "96x72", 16)
    assert 20 <= result["peer_ms"] < 2000  # the double sleeps 20 ms per step
    for preset in peer_step.OURS:
        ours = result[f"ours_{preset}_ms"]
        assert ours > 0
        assert result[f"ratio_{preset}"] == pytest.approx(result["peer_ms"] / ours, rel=0.05, abs=0.01)


def test_a_folder_that_is_no_checkout_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert peer_step.main([str(tmp_path), *SMALL]) == 1
    message = capsys.readouterr().err
    assert f"{tmp_path} is no checkout of the ECCV 2022 code" in message
    assert "advtex_init_align/tex_smooth/optim_patch_torch.py" in message


def test_what_the_peer_lacks_is_told(checkout: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (checkout / "advtex_init_align/tex_smooth/optim_patch_torch.py").write_text("import no_such_library\n")
    assert peer_step.main([str(checkout), *SMALL]) == 1
    message = capsys.readouterr().err
    assert "the peer ended with status 1" in message
    assert "No module named 'no_such_library'" in message
