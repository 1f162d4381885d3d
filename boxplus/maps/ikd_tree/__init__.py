"""The ikd-tree: a k-d tree for points that come and go, with exact nearest neighbours at any time."""

from boxplus.maps.ikd_tree.tree import IkdTree

__all__ = ["IkdTree"]
