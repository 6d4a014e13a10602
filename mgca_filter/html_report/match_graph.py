"""The match graph of a collection: images are nodes, pairs with kept matches are edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

Edge = tuple[int, int, int]


@dataclass(frozen=True)
class MatchGraph:
    """What holds a collection together.

    Attributes:
        groups: of each image, the number of its group: images that a chain of edges joins. Group 0 is the largest; an
            image that no edge touches is a group of its own.
        links: edges (image, image, kept) of the strongest tree of each group, weakest first: of all ways to join the
            images, the tree's weakest edge is as strong as can be (maximum spanning tree, Kruskal 1956).
        bridges: of ``links``, those without which their group falls apart.
    """

    groups: tuple[int, ...]
    links: tuple[Edge, ...]
    bridges: frozenset[tuple[int, int]]


def build_graph(num_images: int, edges: Sequence[Edge]) -> MatchGraph:
    """The graph of ``edges`` (image, image, kept matches); those that keep nothing are left out."""
    strong = sorted((edge for edge in edges if edge[2] > 0 and edge[0] != edge[1]), key=lambda e: (-e[2], e[0], e[1]))
    parent = list(range(num_images))

    def root(node: int) -> int:
        while parent[node] != node:
            parent[node] = parent[parent[node]]
            node = parent[node]
        return node

    links = []
    for edge in strong:
        a, b = root(edge[0]), root(edge[1])
        if a != b:
            parent[a] = b
            links.append(edge)
    members: dict[int, list[int]] = {}
    for image in range(num_images):
        members.setdefault(root(image), []).append(image)
    groups = [0] * num_images
    for number, images in enumerate(sorted(members.values(), key=lambda images: (-len(images), images[0]))):
        for image in images:
            groups[image] = number
    return MatchGraph(tuple(groups), tuple(reversed(links)), _bridges(num_images, strong))


def _bridges(num_images: int, edges: Sequence[Edge]) -> frozenset[tuple[int, int]]:
    """Edges on no cycle (Tarjan 1974), as they came; two edges between the same images make a cycle."""
    neighbours: list[list[tuple[int, int]]] = [[] for _ in range(num_images)]
    for index, (a, b, _) in enumerate(edges):
        neighbours[a].append((b, index))
        neighbours[b].append((a, index))
    reached, lowest = [-1] * num_images, [0] * num_images
    clock, found = 0, set()
    for start in range(num_images):
        if reached[start] >= 0:
            continue
        reached[start] = lowest[start] = clock
        clock += 1
        stack = [(start, -1, iter(neighbours[start]))]
        while stack:
            node, via, rest = stack[-1]
            for other, index in rest:
                if index == via:
                    continue
                if reached[other] >= 0:
                    lowest[node] = min(lowest[node], reached[other])
                    continue
                reached[other] = lowest[other] = clock
                clock += 1
                stack.append((other, index, iter(neighbours[other])))
                break
            else:
                stack.pop()
                if stack:
                    above = stack[-1][0]
                    lowest[above] = min(lowest[above], lowest[node])
                    if lowest[node] > reached[above]:
                        found.add((edges[via][0], edges[via][1]))
    return frozenset(found)
