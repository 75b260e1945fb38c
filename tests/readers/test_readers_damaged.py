"""A few damaged files of every format, read in watched processes; tests.bench.readers takes thousands by night."""

import numpy as np
import pytest

from processor import readers
from processor.model import InputError, Scan
from processor.readers import sandbox
from processor.writers import e57
from processor.writers.cloud import of_scan
from tests.support.files.damaged_files import damaged, good_files, with_check_sums
from tests.support.processes import watched_reading

SAMPLE = 10  # each kind of damage about once for every format


@pytest.fixture(scope="module")
def process():
    started = watched_reading.Watched()
    yield started
    started.close()


@pytest.mark.parametrize("format_", good_files())
def test_damaged_files_are_read_or_refused(process, tmp_path, format_):
    came_to = []
    for number in range(SAMPLE):
        name, content = damaged(format_, number)
        path = tmp_path / name
        path.write_bytes(content)
        what, said = process.read(path)
        came_to.append(what)
        assert what in ("read", "refused"), f"{format_} {number}: {what} {said}"
    assert came_to.count("refused") >= 2


@pytest.mark.parametrize("format_", [name for name in good_files() if name != "h5"])
def test_good_files_are_read(tmp_path, format_):
    for name, content in good_files()[format_]:
        (tmp_path / name).write_bytes(content)
        assert all(len(scan.points) >= 20 for scan in readers.read(tmp_path / name))


def test_crashing_library_gives_an_input_error_and_the_next_file_is_read(tmp_path):
    for number in range(200):
        name, content = damaged("laz", number)
        (tmp_path / name).write_bytes(content)
        try:
            readers.read(tmp_path / name)
        except InputError as error:
            if "crashed" in str(error):
                break
    else:
        pytest.skip("no file of these crashes this version of the library")
    good, content = good_files()["laz"][0]
    (tmp_path / good).write_bytes(content)
    assert len(readers.read(tmp_path / good)[0].points) == 240


def test_reading_has_a_time_limit(tmp_path, monkeypatch):
    name, content = good_files()["e57"][0]
    path = tmp_path / name
    path.write_bytes(content)
    assert len(readers.read(path)) == 2
    monkeypatch.setattr(sandbox, "limit_s", lambda _: 1e-6)
    with pytest.raises(InputError, match=r"a\.e57: reading took more than .* export it again"):
        readers.read(path)
    monkeypatch.undo()
    assert len(readers.read(path)) == 2


def with_xml(content, old, new):
    """An E57 file with a part of its XML replaced by one as long."""
    assert content.count(old) == 1
    assert len(new) <= len(old)
    return with_check_sums(content.replace(old, new.ljust(len(old))))


DECLARATION = b'<?xml version="1.0" encoding="UTF-8"?>'


@pytest.mark.parametrize(
    ("new", "why"),
    [
        (b'<!DOCTYPE e [<!ENTITY a "b">]>', "declares a document type or entities"),
        (b'<!doctype e SYSTEM "file:///a">', "declares a document type or entities"),
        (b'<?xml version="1.0" encoding="UTF-16"?>'[:38], "expected XML in UTF-8|document type|not a readable"),
        (b'<?xml version="1.0" encoding="latin1"?>'[:38], "expected XML in UTF-8, found 'latin1'|not a readable"),
    ],
)
def test_xml_of_e57_has_no_entities(tmp_path, new, why):
    path = tmp_path / "a.e57"
    path.write_bytes(with_xml(good_files()["e57"][0][1], DECLARATION, new))
    with pytest.raises(InputError, match=why):
        readers.read(path)


def test_a_name_in_xml_is_text(tmp_path):
    name = "<script>&\"'</script>"
    e57.write(tmp_path / "a.e57", [of_scan(Scan(name, np.eye(3))), of_scan(Scan("S 2", np.eye(3)))], spherical=False)
    assert [scan.name for scan in readers.read(tmp_path / "a.e57")] == ["a-1", "S 2"]  # no slash in a name
