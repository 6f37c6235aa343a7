"""Binding of query parameters for the drivers, without SQLAlchemy."""

from pathlib import Path

from workflows.engine.database import _bind, default_url, prepare, reading


def test_lists_and_names_with_a_common_prefix_are_bound_once(tmp_path: Path) -> None:
    url = default_url(tmp_path)
    prepare(url)
    query = "SELECT a.column1 FROM (VALUES ('x'), ('y'), ('z')) a WHERE a.column1 IN :run AND a.column1 <> :runs"
    with reading(url) as select:
        assert select(query, {"run": ["x", "y"], "runs": "y"}) == [("x",)]
        assert select("SELECT 1 WHERE 1 IN :ids", {"ids": []}) == []


def test_placeholders_of_postgresql_leave_casts_alone() -> None:
    text = "SELECT l.objid::bigint FROM l WHERE id IN :ids AND n = :n"
    query, values = _bind(text, {"ids": [1, 2], "n": 3}, "%({})s")
    assert query == "SELECT l.objid::bigint FROM l WHERE id IN (%(ids_0)s, %(ids_1)s) AND n = %(n)s"
    assert values == {"ids_0": 1, "ids_1": 2, "n": 3}
