"""Image files: their size by the header alone, and their pixels; whatever a decoder complains about is an error.

The decoders within OpenCV return half an image with a line on the standard error, or raise nearly anything; here both
become the caller's `InputError`.
"""

import os
import re
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from registration.errors import InputError
from registration.storage.reading import Refuse, open_file

if TYPE_CHECKING:
    import numpy as np

MAX_PIXELS = 2**28  # 16384 x 16384: beyond any camera, and a hostile header must not make us allocate more
FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "PPM", "GIF", "JPEG2000")  # Pillow's others start programs or are rare
_DAMAGE = re.compile(r"premature end|corrupt jpeg data|libpng error|\[ERROR:", re.IGNORECASE)
_HARMLESS = re.compile(r"extraneous bytes before marker", re.IGNORECASE)  # some cameras write them
_OF_DECODERS = re.compile(
    r"^(\[ ?(WARN|ERROR|INFO)|OpenCV: FFMPEG|libpng|libjpeg|TIFF|Corrupt JPEG|Premature end|Invalid SOS|\s*$)"
)
_lock = threading.Lock()


def image_size(file: Path, refuse: Refuse) -> tuple[int, int]:
    """Return the width and height (px) that an image file declares.

    Raises:
        InputError: it is missing, no regular file, no image, or declares more than `MAX_PIXELS`.
    """
    from PIL import Image

    with open_file(file, refuse) as stream, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the size, which is limited here, and of metadata, which is ignored
        try:
            with Image.open(stream, formats=FORMATS) as image:
                width_px, height_px = image.size
        except Image.UnidentifiedImageError:
            stream.seek(0)
            got = f"a file that starts with {stream.read(8)!r}"
            raise refuse(expected="a PNG, JPEG or TIFF file", got=got) from None
        except Image.DecompressionBombError as error:
            raise too_many_pixels(file, error) from None
        except Exception as error:  # a damaged header makes Pillow's parsers raise nearly anything
            raise refuse(expected="a PNG, JPEG or TIFF file", got=f"{type(error).__name__}: {error}") from None
    if width_px * height_px > MAX_PIXELS:
        raise too_many_pixels(file, f"{width_px} x {height_px}")
    return width_px, height_px


def too_many_pixels(file: Path, got: object) -> InputError:
    """Return the error for an image of more than `MAX_PIXELS`."""
    return InputError(
        "The image has too many pixels",
        where=file,
        expected=f"at most {MAX_PIXELS} pixels",
        got=got,
        fix="scale it down, and its camera in the COLMAP model likewise",
    )


def decode(file: Path, flags: int, refuse: Refuse) -> "np.ndarray":
    """Return the pixels of an image file as `cv2.imread` does with these flags. Check its size first.

    Raises:
        InputError: it cannot be decoded, not even in part.
    """
    import cv2

    open_file(file, refuse).close()  # it is a regular file
    return _decoded(lambda: cv2.imread(str(file), flags), refuse)


def decode_content(content: bytes | bytearray, flags: int, refuse: Refuse) -> "np.ndarray":
    """Return the pixels in the content of an image file, as `decode`. Raises InputError as `decode`."""
    import cv2
    import numpy as np

    return _decoded(lambda: cv2.imdecode(np.frombuffer(content, np.uint8), flags), refuse)


def _decoded(read: "Callable[[], np.ndarray | None]", refuse: Refuse) -> "np.ndarray":
    import cv2

    with _decoder_messages() as messages:
        try:
            pixels = read()
        except (cv2.error, MemoryError) as error:
            raise refuse(expected="a whole, undamaged image", got=_brief(str(error))) from None
    complaints = [line for line in messages if _DAMAGE.search(line) and not _HARMLESS.search(line)]
    if pixels is None or complaints:
        got = _brief(complaints[0]) if complaints else "a decoding error"
        raise refuse(expected="a whole, undamaged image", got=got)
    return pixels


@contextmanager
def quiet_decoders() -> Iterator[None]:
    """Drop what OpenCV's libraries write to the standard error in the block; what others write passes."""
    with _decoder_messages():
        yield


def _brief(message: str) -> str:
    """A decoder's message without its place in OpenCV's source."""
    text = re.sub(r"^\[ERROR:\S+\]\s+global\s+\S+\s+\S+\s+", "", message.strip().splitlines()[0] if message else "")
    return re.sub(r"^OpenCV\(\S+\)\s+\S+ error: \(\S+?\)\s*", "", text)[:200] or "a decoding error"


@contextmanager
def _decoder_messages() -> Iterator[list[str]]:
    """Yield a list that holds, after the block, the lines that decoders wrote to the standard error meanwhile.

    They write to the descriptor, past Python. Lines of others, from other threads, are passed on.
    """
    lines: list[str] = []
    with _lock, tempfile.TemporaryFile() as file:
        try:
            sys.stderr.flush()
            saved = os.dup(2)
        except (OSError, ValueError, AttributeError):  # there is no standard error
            yield lines
            return
        try:
            os.dup2(file.fileno(), 2)
            yield lines
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            file.seek(0)
            lines += file.read(2**16).decode("utf-8", "replace").splitlines()
            others = [line for line in lines if not _OF_DECODERS.match(line)]
            if others:
                sys.stderr.write("\n".join((*others, "")))
