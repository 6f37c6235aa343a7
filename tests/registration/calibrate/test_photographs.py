from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from registration.calibrate.photographs import duplicates, find_photographs, focal_groups, read_pixels
from registration.errors import InputError

DETAILS, FOCAL_MM, FOCAL_35MM, MAKE, MODEL, ORIENTATION = 0x8769, 0x920A, 0xA405, 0x010F, 0x0110, 0x0112


def write(
    file: Path, size: tuple[int, int] = (60, 80), seed: int = 0, exif: dict[int, object] | None = None, mm: float = 0
) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 255, (size[1], size[0], 3), np.uint8)
    image = Image.fromarray(pixels)
    entries = Image.Exif()
    for key, value in (exif or {}).items():
        entries[key] = value
    if mm:
        entries.get_ifd(DETAILS).update({FOCAL_MM: mm, FOCAL_35MM: int(1.5 * mm)})
    image.save(file, exif=entries)
    return file


def test_photographs_are_found_below_the_folder_in_natural_order(tmp_path: Path) -> None:
    for name in ("b10.png", "b9.png", "left/a.jpg", "notes.txt", ".hidden/c.png"):
        write(tmp_path / name) if not name.endswith("txt") else (tmp_path / name).write_text("x")
    found = find_photographs(tmp_path)
    assert [photograph.name for photograph in found] == ["b9", "b10", "left/a"]
    assert (found[0].width_px, found[0].height_px, found[0].centre_px) == (60, 80, (30.0, 40.0))
    assert [photograph.name for photograph in find_photographs([photograph.file for photograph in found])] == [
        "b9",
        "b10",
        "left/a",
    ]


@pytest.mark.parametrize("names", [(), ("a.png", "a.jpg")])
def test_no_photographs_and_two_of_one_name_are_refused(tmp_path: Path, names: tuple[str, ...]) -> None:
    for name in names:
        write(tmp_path / name)
    with pytest.raises(InputError):
        find_photographs(tmp_path)


def test_a_missing_folder_and_a_damaged_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="missing"):
        find_photographs(tmp_path / "none")
    (tmp_path / "a.png").write_bytes(b"no image")
    with pytest.raises(InputError, match="photograph cannot be read"):
        find_photographs(tmp_path)


def test_exif_gives_the_focal_length_and_groups(tmp_path: Path) -> None:
    body = {MAKE: "Maker", MODEL: "Body"}
    files = [
        write(tmp_path / "a.jpg", (60, 80), 1, body, 50),
        write(tmp_path / "b.jpg", (80, 60), 2, body, 50),  # landscape, of the same camera
        write(tmp_path / "c.jpg", (60, 80), 3, body, 35),
        write(tmp_path / "d.jpg", (60, 80), 4),
        write(tmp_path / "e.jpg", (120, 160), 5),
    ]
    found = find_photographs(files)
    assert found[0].focal_px == pytest.approx(75 / 43.267 * 100, rel=1e-3)  # 100 px is the diagonal
    assert found[3].focal_px is None and found[0].device == "Maker Body"
    names, group = focal_groups(found, "camera")
    assert group.tolist() == [0, 0, 1, 2, 3]
    assert names[0] == "80 x 60, Maker Body, 50 mm"
    assert focal_groups(found, "size")[1].tolist() == [0, 0, 0, 0, 1]
    assert focal_groups(found, "view")[1].tolist() == [0, 1, 2, 3, 4]


def test_folders_are_groups(tmp_path: Path) -> None:
    for name in ("left/a.png", "left/b.png", "right/a.png"):
        write(tmp_path / name)
    assert focal_groups(find_photographs(tmp_path), "folder")[1].tolist() == [0, 0, 1]


def test_pixels_are_used_as_stored(tmp_path: Path) -> None:
    file = write(tmp_path / "a.png", (60, 80), exif={ORIENTATION: 6})
    (photograph,) = find_photographs([file])
    pixels, factor = read_pixels(photograph, 100)
    assert pixels.shape == (80, 60, 3) and factor == 1.0
    assert (pixels == cv2.imread(str(file), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)).all()


def test_large_photographs_are_reduced_and_deep_ones_are_8_bit(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.full((90, 120, 3), 40000, np.uint16))
    (photograph,) = find_photographs(tmp_path)
    pixels, factor = read_pixels(photograph, 40)
    assert pixels.shape == (30, 40, 3) and pixels.dtype == np.uint8 and factor == 3.0
    assert (np.abs(pixels.astype(int) - round(40000 / 257)) <= 1).all()


def test_equal_files_are_duplicates(tmp_path: Path) -> None:
    for name, seed in (("a.png", 1), ("b.png", 2), ("c.png", 1)):
        write(tmp_path / name, seed=seed)
    assert duplicates(find_photographs(tmp_path)) == {2: 0}
