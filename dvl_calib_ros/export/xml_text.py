"""XML as text."""

from __future__ import annotations

import xml.etree.ElementTree as ET


def xml_text(root: ET.Element) -> str:
    """A document with a declaration, indented."""
    ET.indent(root, space="  ")
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"
