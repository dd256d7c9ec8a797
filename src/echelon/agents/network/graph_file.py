"""Graphs in files: lists of edges, adjacency matrices, GraphML, and sparse matrices of SciPy."""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from echelon.core.errors import GraphError
from echelon.core.text_table import Column, TextTable, number_in, read_table, read_text
from echelon.core.types import Array, PathLike
from echelon.core.words import amount

_ENDS = (
    Column("source", "", ("from", "i", "sender", "src", "tail", "node1", "node_1", "u")),
    Column("target", "", ("to", "j", "receiver", "dst", "head", "node2", "node_2", "v")),
    Column("weight", "", ("w",), optional=True),
)
_DICTIONARY = re.compile(r"\{(?:'weight': *([^,}]+))?.*\}")
"""What networkx writes after the nodes of an edge."""


class FileEdges(NamedTuple):
    """The edges of a file; agents are numbered as `number_nodes` says.

    Attributes:
        edges: (i, j, weight).
        directed: whether the file says that edges are directed; None where it does not say.
    """

    edges: list[tuple[int, int, float]]
    agents: int
    directed: bool | None


def read_graph(file: PathLike) -> "FileEdges | Array":
    """Return the edges in a file, or its adjacency matrix (N, N), dense or sparse.

    Raises:
        GraphError: the file cannot be read, or is neither a list of edges, nor a square matrix, nor
            GraphML, nor a sparse matrix of SciPy.
    """
    suffix = Path(file).suffix.lower()
    if suffix == ".npz":
        return _read_sparse(file)
    if suffix == ".graphml":
        return _read_graphml(file)
    table = read_table(file, "graph", GraphError)
    if all(table.has(column) for column in _ENDS[:2]):
        assert table.head is not None
        where = [table.find(column) for column in _ENDS]
        pick = [[row.cells[k] for k in where if k is not None] for row in table.rows]
        return _edges_of(table, pick, [row.line for row in table.rows])
    matrix = _matrix_of(table)
    if matrix is not None:
        return matrix
    rows = table.rows if table.head is None else [table.head, *table.rows]
    cells = [_without_dictionary(row.cells) for row in rows]
    wrong = next((k for k, part in enumerate(cells) if len(part) not in (2, 3)), None)
    if wrong is not None:
        raise GraphError(
            f"{table.place(rows[wrong].line)} has {amount(len(cells[wrong]), 'column')} and the "
            f"file {amount(len(rows), 'line')}, {table.separated}; allowed are edges (2 or 3 "
            "columns: from, to, weight) or a square matrix."
        )
    return _edges_of(table, cells, [row.line for row in rows])


def number_nodes(names: Sequence[str], where: str = "") -> dict[str, int]:
    """Return the agent of each node, by its name.

    Whole numbers are themselves, names such as `n0`, `n1` are in the order of their numbers, and
    others in the order in which they first occur.

    Raises:
        GraphError: nodes are numbered from 1.
    """
    names = list(dict.fromkeys(names))
    found = [re.fullmatch(r"(\D*)(\d{1,9})", name) for name in names]
    if not all(found) or len({match[1] for match in found if match}) > 1:
        return {name: k for k, name in enumerate(names)}
    numbers = {name: int(match[2]) for name, match in zip(names, found, strict=True) if match}
    if found[0] and found[0][1]:
        return {name: k for k, name in enumerate(sorted(names, key=numbers.__getitem__))}
    if sorted(numbers.values()) == list(range(1, len(names) + 1)):
        raise GraphError(
            f"the nodes{where} are numbered from 1 to {len(names)}, and must be numbered from 0."
        )
    return numbers


def _edges_of(table: TextTable, rows: list[list[str]], lines: list[int]) -> FileEdges:
    weights = []
    for row, line in zip(rows, lines, strict=True):
        weight = number_in(row[2]) if len(row) == 3 and row[2] else 1.0
        if weight is None or not row[0] or not row[1]:
            raise GraphError(
                f"{table.place(line)} is {row}, {table.separated}, and must be an edge: from, to, "
                "and where given its weight."
            )
        weights.append(weight)
    pairs = [(row[0], row[1]) for row in rows]
    return _numbered(table.file, pairs, weights, [], None)


def _numbered(
    file: PathLike,
    pairs: list[tuple[str, str]],
    weights: list[float],
    nodes: list[str],
    directed: bool | None,
) -> FileEdges:
    names = [*nodes, *(name for pair in pairs for name in pair)]
    numbers = number_nodes(names, f" of `{file}`")
    edges = [(numbers[i], numbers[j], w) for (i, j), w in zip(pairs, weights, strict=True)]
    return FileEdges(edges, max(numbers.values(), default=0) + 1, directed)


def _without_dictionary(cells: list[str]) -> list[str]:
    match = _DICTIONARY.fullmatch(" ".join(cells[2:]))
    return cells if match is None else [*cells[:2], *([match[1]] if match[1] else [])]


def _matrix_of(table: TextTable) -> Array | None:
    """Return an adjacency matrix; None for what is none. Its header and first column may name."""
    count, cells = len(table.rows), [row.cells for row in table.rows]
    if table.head is not None and {len(row) for row in cells} == {count + 1}:
        cells = [row[1:] for row in cells]
    if count < 3 or any(len(row) != count for row in cells):
        return None
    numbers = [[number_in(cell) for cell in row] for row in cells]
    # Three edges with weights are not a matrix of three agents: a weight is not zero.
    if count == 3 and any(numbers[k][k] for k in range(3)) or None in sum(numbers, []):
        return None
    return np.array(numbers, float)


def _read_sparse(file: PathLike) -> Array:
    from scipy.sparse import load_npz

    try:
        return load_npz(str(file))
    except OSError as error:
        raise GraphError(f"the graph `{file}` cannot be read: {error.strerror or error}.") from None
    except Exception:  # whatever a damaged file causes
        raise GraphError(
            f"the graph `{file}` is no sparse matrix that `scipy.sparse.save_npz` wrote."
        ) from None


def _read_graphml(file: PathLike) -> FileEdges:
    try:
        root = ElementTree.fromstring(read_text(file, "graph", GraphError))
    except (ElementTree.ParseError, ValueError) as error:
        raise GraphError(f"the graph `{file}` is not GraphML: {error}.") from None
    graph = root.find("{*}graph")
    keys = [key.get("id") for key in root.iterfind("{*}key") if key.get("attr.name") == "weight"]
    nodes = [] if graph is None else [node.get("id", "") for node in graph.iterfind("{*}node")]
    if graph is None or not nodes:
        raise GraphError(f"the graph `{file}` has no `graph` with nodes.")
    pairs, weights = [], []
    for k, edge in enumerate(graph.iterfind("{*}edge"), 1):
        pair = edge.get("source", ""), edge.get("target", "")
        texts = [part.text or "" for part in edge.iterfind("{*}data") if part.get("key") in keys]
        weight = number_in(texts[0].strip()) if texts else 1.0
        if weight is None or not {*pair} <= {*nodes}:
            raise GraphError(
                f"edge {k} of the graph `{file}` is from `{pair[0]}` to `{pair[1]}` with weight "
                f"{texts or 1}, and must link two of its nodes by a number."
            )
        pairs.append(pair)
        weights.append(weight)
    return _numbered(file, pairs, weights, nodes, graph.get("edgedefault") == "directed")
