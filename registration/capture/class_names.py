"""The names of label classes: those that the model knows, and what other vocabularies call them."""

import difflib
import re
from collections.abc import Collection

from registration.model.regions import CLASSES

BACKGROUND = "background"
NECK = "neck_other"
UNLABELLED = "unlabelled"
KNOWN = (BACKGROUND, *CLASSES, NECK)

# What covers a head or is not known: excluded from every comparison on purpose.
_COVERS = re.compile(
    r"hair|beard|moustache|cloth|shirt|apparel|hat$|helmet|cap$|glass|eye_?g$|ear_?r(ing)?s?$|earphone|headset"
    r"|neck_?l(ace)?$|mask|band|hand|arm$|leg$|foot$|shoe$|sock$|person|other|ignore|unlabel|void|unknown|accessor"
)
_SKIN = "face face_skin facial_skin head nose nostril cheek forehead chin face_neck"
_BROWS = "brow eyebrow lb rb"  # with a side before or behind: below
_MOUTH = "mouth inner_mouth imouth teeth upper_teeth lower_teeth tongue gums"
_SIDES = {"left": ("l", "left"), "right": ("r", "right")}
_LIPS = ("upper_lip", "lower_lip")
_EARRING = "ear_r"  # of CelebAMask-HQ, unless there is an ear_l, too


def _sided(part: str) -> list[tuple[str, str]]:
    """Spellings of a part with a side, each with the side."""
    return [
        (spelling, side)
        for side, words in _SIDES.items()
        for word in words
        for spelling in (f"{word}_{part}", f"{part}_{word}", f"{word}{part}")
    ]


_OTHER_NAMES = (
    dict.fromkeys(("bg", "back"), BACKGROUND)
    | dict.fromkeys([*_SKIN.split(), *_BROWS.split(), "eyes", "brows", "eyebrows", "lips"], "skin")
    | {name: "skin" for part in ("brow", "eyebrow") for name, _ in _sided(part)}
    | {name: f"{side}_eye" for name, side in _sided("eye")}
    | {"le": "left_eye", "re": "right_eye"}
    | dict.fromkeys(["ear", "lr", "rr", *({name for name, _ in _sided("ear")} - {_EARRING})], "ears")
    | dict.fromkeys(("u_lip", "ulip", "ul", "lip_upper", "upperlip"), "upper_lip")
    | dict.fromkeys(("l_lip", "llip", "ll", "lip_lower", "lowerlip"), "lower_lip")
    | dict.fromkeys([*_MOUTH.split(), "im"], "mouth_interior")
    | dict.fromkeys(("neck", "body", "body_skin", "torso"), NECK)
)


def meaning(name: str) -> str | None:
    """Return the class that a name means: a known one, or what covers the head, as it is spelt; None: no idea.

    Case, spaces, hyphens and underscores do not matter. Left and right are taken as the subject's.
    """
    plain = _plain(name)
    if plain in KNOWN:
        return plain
    if plain in _OTHER_NAMES:
        return _OTHER_NAMES[plain]
    return plain if covers(name) else None


def meanings(names: Collection[str]) -> dict[str, str | None]:
    """Return what each name of a vocabulary means, as `meaning`.

    "mouth" is the interior only where the vocabulary has lips, too; else it is skin, as all that is not distinguished.
    "ear_r" is an earring, as in CelebAMask-HQ, but beside "ear_l" an ear.
    """
    found = {name: meaning(name) for name in names}
    if any(_plain(name) == "ear_l" for name in names):
        found.update({name: "ears" for name in names if _plain(name) == _EARRING})
    if not any(lip in found.values() for lip in _LIPS):
        found.update({name: "skin" for name in names if _plain(name) == "mouth"})
    return found


def exchanged(name: str) -> str:
    """Return the class on the other side of the head: left_eye for right_eye and vice versa."""
    sides = {"left_eye": "right_eye", "right_eye": "left_eye"}
    return sides.get(name, name)


def is_spelling(name: str, known: str) -> bool:
    """Whether a name differs from a class in case, spaces, hyphens and underscores only."""
    return _plain(name) == known


def suggestion(name: str) -> str | None:
    """Return the known class that a name probably means; None if there is none, as for clothes."""
    found = meaning(name)
    if found in KNOWN:
        return found
    if found is not None:
        return None
    plain = _plain(name)
    near = difflib.get_close_matches(plain, [*KNOWN, *_OTHER_NAMES], 1, 0.75)
    return meaning(near[0]) if near else None


def covers(name: str) -> bool:
    """Whether a class is something that covers the head, such as hair or clothes: left out on purpose."""
    return _COVERS.search(_plain(name)) is not None


def _plain(name: str) -> str:
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name.strip().removesuffix(".png"))
    return re.sub(r"[\s\-_.]+", "_", spaced).casefold()
