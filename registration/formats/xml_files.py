"""XML files of other programs: elements with their line numbers, so that an error names the place.

Document types and entities are refused: they can make a small file expand without limit, or read other files. The
files that are read here have neither.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from registration.errors import InputError
from registration.storage.reading import MAX_DEPTH, MAX_TEXT_BYTES, Refuse, read_bytes

MAX_ELEMENTS = 2**20
FIX = "export it again, or see docs/formats.md"


@dataclass(kw_only=True)
class Element:
    """An element of an XML file.

    Attributes:
        file: the file, for messages.
        name: local name; "URI name" where it is of a namespace.
        line: of its start tag, from 1.
        attributes: name -> value; names as above.
        text: the text before, between and after the child elements.
        children: elements within it, in order.
    """

    file: str
    name: str
    line: int
    attributes: dict[str, str] = field(default_factory=dict)
    text: str = ""
    children: list["Element"] = field(default_factory=list)

    @property
    def where(self) -> str:
        """The place of the element, for messages."""
        return f"{self.file}, line {self.line}, <{self.name.rpartition(' ')[2]}>"

    def error(self, expected: object, got: object, fix: str = FIX) -> InputError:
        """Return the error of this element."""
        return InputError("The XML file cannot be used", where=self.where, expected=expected, got=got, fix=fix)

    def refuse(self, fix: str = FIX) -> Callable[[str, object, object], InputError]:
        """Return the function that makes this element's error of an entry, what was expected and what was found."""
        return lambda _, expected, got: self.error(expected, got, fix)

    def all(self, name: str) -> list["Element"]:
        """Return the child elements of a name."""
        return [child for child in self.children if child.name == name]

    def descendants(self, name: str) -> Iterator["Element"]:
        """Yield the elements of a name at any depth, in order."""
        for child in self.children:
            if child.name == name:
                yield child
            yield from child.descendants(name)

    def find(self, path: str) -> "Element | None":
        """Return the element at a path of names such as "transform/scale", None if there is none.

        Raises:
            InputError: an element of the path is there twice.
        """
        element = self
        for name in path.split("/"):
            found = element.all(name)
            if not found:
                return None
            if len(found) > 1:
                raise found[1].error(f"one <{name}> in <{element.name}>", f"another one in line {found[0].line}")
            element = found[0]
        return element

    def need(self, path: str) -> "Element":
        """Return the element at a path. Raises InputError if there is none, or two."""
        if (found := self.find(path)) is None:
            raise self.error(f"an element <{path}>", "none")
        return found

    def attribute(self, name: str) -> str:
        """Return an attribute's value. Raises InputError if there is none."""
        if name not in self.attributes:
            raise self.error(f'an attribute "{name.rpartition(" ")[2]}"', "none")
        return self.attributes[name]

    def numbers(self, count: int) -> np.ndarray:
        """Return the element's text as float64 numbers separated by spaces. Raises InputError for others."""
        return parse_numbers(self.text, count, self)

    def number(self) -> float:
        """Return the element's text as a finite number. Raises InputError."""
        return float(self.numbers(1)[0])

    def value(self, path: str, default: float | None = None) -> float:
        """Return the number in the element at a path. Raises InputError, also if it is missing without a default."""
        element = self.find(path) if default is not None else self.need(path)
        return element.number() if element is not None else float(default or 0.0)

    def pixels(self, text: str) -> int:
        """Return a size in pixels, 1 to 65535. Raises InputError."""
        value = float(parse_numbers(text, 1, self)[0])
        if value != int(value) or not 0 < value < 2**16:
            raise self.error("a whole number of pixels from 1 to 65535", text.strip())
        return int(value)


def parse_numbers(text: str, count: int, element: Element) -> np.ndarray:
    """Return numbers separated by spaces, float64, shape (count,). Raises InputError, as of the element."""
    words = text.split()
    if len(words) != count:
        raise element.error(f"{count} numbers", f"{len(words)}: {text.strip()!r:.60}")
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise element.error(f"{count} numbers", repr(text.strip())[:60]) from None
    if not all(map(math.isfinite, values)):
        raise element.error("finite numbers", repr(text.strip())[:60])
    return np.array(values)


def read_xml(file: Path) -> Element:
    """Read an XML file.

    Raises:
        InputError: it is missing, larger than `MAX_TEXT_BYTES`, not well-formed, has a document type or entities, more
            than `MAX_ELEMENTS` elements, or deeper ones than `MAX_DEPTH`.
    """
    refuse = partial(InputError, "The XML file cannot be read", where=file, fix=FIX)
    return parse_xml(read_bytes(file, refuse, max_bytes=MAX_TEXT_BYTES), str(file), refuse)


def parse_xml(content: bytes, file: str, refuse: Refuse) -> Element:
    """Return the root element of an XML text.

    Args:
        content: the text.
        file: its name, for the messages of later errors.
        refuse: makes the error.

    Raises:
        InputError: as `read_xml`.
    """
    parser = expat.ParserCreate(namespace_separator=" ")
    parser.buffer_text = True
    parser.SetParamEntityParsing(expat.XML_PARAM_ENTITY_PARSING_NEVER)
    open_elements: list[Element] = []
    roots: list[Element] = []
    count = 0

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if count > MAX_ELEMENTS or len(open_elements) >= MAX_DEPTH:
            limit = f"at most {MAX_ELEMENTS} elements, {MAX_DEPTH} deep"
            raise refuse(expected=limit, got=f"more, in line {parser.CurrentLineNumber}")
        element = Element(file=file, name=name, line=parser.CurrentLineNumber, attributes=attributes)
        (open_elements[-1].children if open_elements else roots).append(element)
        open_elements.append(element)

    def end(_: str) -> None:
        open_elements.pop()

    def text(data: str) -> None:
        if open_elements:
            open_elements[-1].text += data

    def forbidden(*_: Any) -> Any:
        line = parser.CurrentLineNumber
        raise refuse(expected="XML without a document type and entities", got=f"one in line {line}")

    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, text
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = parser.ExternalEntityRefHandler = forbidden
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        got = f"{expat.ErrorString(error.code)} in line {error.lineno}"
        raise refuse(expected="well-formed XML", got=got) from None
    except (ValueError, LookupError) as error:  # an encoding that Python does not know
        raise refuse(expected="XML in a known encoding", got=error) from None
    return roots[0]
