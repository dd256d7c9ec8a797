"""Graphs in files: lists of edges, adjacency matrices, GraphML, and sparse matrices of SciPy."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from echelon.core.errors import GraphError
from echelon.core.text_table import Column, TextTable, number_in, read_table, read_xml
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
    table = read_table(file, "graph", GraphError).headed(_ENDS)
    where = [k for column in _ENDS if (k := table.find(column)) is not None]
    if all(map(table.has, _ENDS[:2])):
        pick = [[row.cells[k] for k in where] for row in table.rows]
        return _edges_of(table, pick, [row.line for row in table.rows])
    if (matrix := _matrix_of(table)) is not None:
        return matrix
    rows = table.rows if table.head is None else [table.head, *table.rows]
    cells = [_without_dictionary(row.cells) for row in rows]
    for row, part in zip(rows, cells, strict=True):
        if len(part) not in (2, 3):
            raise GraphError(
                f"{table.place(row.line)} has {amount(len(part), 'column')} and the file "
                f"{amount(len(rows), 'line')}, {table.separated}; allowed are edges (2 or 3 "
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
    edges = []
    for row, line in zip(rows, lines, strict=True):
        weight = number_in(row[2]) if len(row) == 3 and row[2] else 1.0
        if weight is None or not row[0] or not row[1]:
            raise GraphError(
                f"{table.place(line)} is {row}, {table.separated}, and must be an edge: from, to, "
                "and where given its weight."
            )
        edges.append((row[0], row[1], weight))
    return _numbered(table.file, edges, [], None)


def _numbered(
    file: PathLike, edges: list[tuple[str, str, float]], nodes: list[str], directed: bool | None
) -> FileEdges:
    names = [*nodes, *(name for edge in edges for name in edge[:2])]
    numbers = number_nodes(names, f" of `{file}`")
    numbered = [(numbers[i], numbers[j], weight) for i, j, weight in edges]
    return FileEdges(numbered, max(numbers.values(), default=0) + 1, directed)


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
    root = read_xml(file, "graph", GraphError, "GraphML")
    graph = root.find("{*}graph")
    keys = [key.get("id") for key in root.iterfind("{*}key") if key.get("attr.name") == "weight"]
    nodes = [] if graph is None else [node.get("id", "") for node in graph.iterfind("{*}node")]
    if graph is None or not nodes:
        raise GraphError(f"the graph `{file}` has no `graph` with nodes.")
    edges = []
    for k, edge in enumerate(graph.iterfind("{*}edge"), 1):
        i, j = edge.get("source", ""), edge.get("target", "")
        texts = [part.text or "" for part in edge.iterfind("{*}data") if part.get("key") in keys]
        weight = number_in(texts[0].strip()) if texts else 1.0
        if weight is None or not {i, j} <= {*nodes}:
            raise GraphError(
                f"edge {k} of the graph `{file}` is from `{i}` to `{j}` with weight {texts or 1}, "
                "and must link two of its nodes by a number."
            )
        edges.append((i, j, weight))
    return _numbered(file, edges, nodes, graph.get("edgedefault") == "directed")
