"""Kernels are compiled anew where one within them has changed."""

from tests.support import kernels


def test_kernels_of_all_users_of_a_changed_one_are_discarded(tmp_path, monkeypatch):
    sources = {
        "inner": "from numba import njit\nSTEP = 1\n",
        "outer": "from numba import njit\nimport inner\n",
        "other": "from numba import njit\n",
        "caller": "import outer\n",
    }
    paths = {name: tmp_path / f"{name}.py" for name in sources}
    (tmp_path / "__pycache__").mkdir()
    compiled = {name: tmp_path / f"__pycache__/{name}.work-3.py311.nbi" for name in sources}
    for name, text in sources.items():
        paths[name].write_text(text, "utf-8")
    monkeypatch.setattr(kernels, "MODULES", paths)
    monkeypatch.setattr(kernels, "STATE", tmp_path / "state/kernels.json")
    assert kernels.discard_stale()  # nothing is known of what was compiled before
    for path in compiled.values():
        path.touch()
    assert not kernels.discard_stale()
    paths["inner"].write_text(sources["inner"].replace("1", "2"), "utf-8")
    assert kernels.discard_stale()
    assert [name for name, path in compiled.items() if path.exists()] == ["other", "caller"]
