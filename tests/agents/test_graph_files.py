"""Graphs in files: edges, matrices, GraphML and sparse matrices, compared with networkx."""

import networkx as nx
import numpy as np
import pytest
import scipy.sparse

import echelon as ech

EXPECTED = [(0, 1, 0.5), (0, 2, 1.0), (2, 3, 2.0)]


def edges(graph):
    return [
        (int(i), int(j), float(w)) for (i, j), w in zip(graph.edges, graph.weights, strict=True)
    ]


MATRIX = "0;0,5;1;0\n0,5;0;0;0\n1;0;0;2\n0;0;2;0\n"
FORMS = {
    "edges": "0,1,0.5\n0,2,1\n2,3,2\n",
    "edges with names, in another order": "weight;to;note;from\n0,5;1;a;0\n1;2;b;0\n2;3;c;2\n",
    "edges of blanks": "# i j w\n0 1 0.5\n0 2 1\n2 3 2\n",
    "edges of networkx": "0 1 {'weight': 0.5}\n0 2 {}\n2 3 {'weight': 2.0, 'kind': 'radio'}\n",
    "texts": "lead b 0.5\nlead c 1\nc d 2\n",
    "numbered texts": "uav2 uav3 2\nuav0 uav2 1\nuav0 uav1 0.5\n",
    "matrix": MATRIX,
    "matrix with names": "a;b;c;d\n" + MATRIX,
    "matrix with names on two sides": ";a;b;c;d\n"
    + "".join(f"{n};{row}\n" for n, row in zip("abcd", MATRIX.splitlines(), strict=True)),
}


@pytest.mark.parametrize("form", FORMS)
def test_a_table_is_read(tmp_path, form):
    (tmp_path / "graph.csv").write_text(FORMS[form], "utf-8")
    assert sorted(edges(ech.Graph.read(tmp_path / "graph.csv"))) == EXPECTED
    assert ech.Graph.read(tmp_path / "graph.csv", directed=True).directed


@pytest.mark.parametrize("names", [(0, 1, 2, 3), ("n0", "n1", "n2", "n3"), ("lead", "b", "c", "d")])
@pytest.mark.parametrize("kind", [nx.Graph, nx.DiGraph])
def test_graphml_of_networkx_is_the_same_graph(tmp_path, names, kind):
    graph = kind()
    graph.add_nodes_from(names)
    graph.add_weighted_edges_from((names[i], names[j], w) for i, j, w in EXPECTED)
    nx.write_graphml(graph, tmp_path / "graph.graphml")
    found = ech.Graph.read(tmp_path / "graph.graphml")
    assert sorted(edges(found)) == EXPECTED and found.directed is graph.is_directed()
    assert ech.Graph.from_networkx(nx.read_graphml(tmp_path / "graph.graphml")) == found
    assert ech.Graph.from_networkx(graph) == found


def test_a_sparse_matrix_is_the_same_graph(tmp_path):
    one_way = nx.gn_graph(40, seed=1).reverse()
    for graph in (nx.path_graph(40), nx.relabel_nodes(one_way, dict(enumerate(range(40))))):
        matrix = nx.to_scipy_sparse_array(graph, dtype=float).T
        scipy.sparse.save_npz(tmp_path / "graph.npz", matrix)
        found = ech.Graph.read(tmp_path / "graph.npz")
        assert {*map(tuple, found.edges.tolist())} == {*graph.edges}
        assert found == ech.Graph.from_adjacency(matrix.toarray())
        assert found.directed is graph.is_directed()


def test_a_scenario_names_its_file_and_a_run_copies_it(tmp_path, echelon):
    np.savetxt(tmp_path / "graph.csv", [[0, 1], [1, 2]], fmt="%d", delimiter=",")
    keys = "graph: {file: graph.csv, leaders: [1]}\nsimulation: {horizon: 0.1, dt: 0.01}\n"
    text = f"name: filed\nmodel: {{name: single-integrator}}\n{keys}"
    (tmp_path / "filed.yaml").write_text(text, "utf-8")
    assert (
        echelon("run", tmp_path / "filed.yaml", "--out", tmp_path / "run", "--no-figures")[0] == 0
    )
    (tmp_path / "graph.csv").unlink()
    graph = ech.build(ech.load_scenario(tmp_path / "run")).parts.graph
    assert graph == ech.Graph([(0, 1), (1, 2)], leaders=[1])
    # In place of a graph by its name, whose keys are left out then, and its leaders are not.
    np.savetxt(tmp_path / "other.csv", [[0, 1], [1, 2], [2, 3]], fmt="%d")
    named = text.replace("file: graph.csv", "name: path, agents: 3")
    (tmp_path / "named.yaml").write_text(named, "utf-8")
    changed = ech.load_scenario(tmp_path / "named.yaml", [f"graph.file={tmp_path / 'other.csv'}"])
    assert ech.build(changed).parts.graph == ech.Graph.path(4, leaders=[1])


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("g.csv", "1,2\n2,3\n", "the nodes of `.*g.csv` are numbered from 1 to 3, and must be"),
        ("g.csv", "0,1\n1,1\n", "of the graph `.*g.csv`: edge .1, 1. links agent 1 to itself"),
        ("g.csv", "0,1,2,3\n1,2,3,4\n", "g.csv:1` has 4 columns and the file 2 lines, separated"),
        ("g.csv", "0;1;much\n", "g.csv:1` is .'0', '1', 'much'., separated by semicolons"),
        ("g.graphml", "<graphml/>", "has no `graph` with nodes."),
        ("g.graphml", "0,1\n", "is not GraphML: "),
        ("g.npz", "no", "is no sparse matrix that `scipy.sparse.save_npz` wrote."),
        (
            "g.graphml",
            "<graphml><graph><node id='a'/><edge source='a' target='b'/></graph></graphml>",
            "edge 1 of the graph `.*` is from `a` to `b`",
        ),
    ],
)  # fmt: skip
def test_a_wrong_file_is_refused(tmp_path, name, content, said):
    (tmp_path / name).write_text(content, "utf-8")
    with pytest.raises(ech.errors.GraphError, match=said) as error:
        ech.Graph.read(tmp_path / name)
    assert name in str(error.value)
    with pytest.raises(ech.errors.GraphError, match="cannot be read: No such file"):
        ech.Graph.read(tmp_path / f"no-{name}")
