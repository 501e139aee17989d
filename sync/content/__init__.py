"""When the cameras' pictures were filmed, by what they show (docs/sync.md)."""

from sync.content.activity import Activity
from sync.content.offsets import Content, ContentOptions, Offset, Window, find_offsets

__all__ = ["Activity", "Content", "ContentOptions", "Offset", "Window", "find_offsets"]
