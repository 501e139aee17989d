"""XML, of which every format reads a few elements."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from calibration.importers.texts import FaultError, number


def root(file: Path) -> Element:
    try:
        return ElementTree.parse(file).getroot()
    except (ElementTree.ParseError, LookupError, ValueError) as problem:
        raise FaultError(f"{file} is no XML: {problem}") from None


def root_tag(file: Path) -> str:
    """Name of the outermost element; empty for what is no XML."""
    try:
        with file.open("rb") as source:
            return str(next(ElementTree.iterparse(source, ["start"]))[1].tag)
    except (ElementTree.ParseError, LookupError, ValueError, StopIteration):
        return ""


def attribute(element: Element, key: str, what: str) -> float:
    if key not in element.attrib:
        raise ValueError(f"{what}: {element.tag} must have {key}, but has {sorted(element.attrib)}")
    return number(element.attrib[key], f"{what}: {key}")


def child(element: Element, path: str, what: str) -> Element:
    found = element.find(path)
    if found is None:
        raise ValueError(f"{what} must have {path}, but has {sorted({part.tag for part in element})}")
    return found


def text_number(element: Element, path: str, what: str, otherwise: float = 0.0) -> float:
    """The number in an element that may be absent."""
    found = element.find(path)
    return otherwise if found is None else number((found.text or "").strip(), f"{what}: {path}")
