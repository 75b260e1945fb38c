"""The report's page made and read: its tables, scripts, addresses and text."""

import copy
import csv
import hashlib
import io
import pickle
from html.parser import HTMLParser

from matplotlib.backends.backend_agg import FigureCanvasAgg

from processor.evaluation.evaluate import ErrorReport
from processor.report import all_figures, all_tables, page
from processor.report.table import csv_text

BAD = "</script><script>alert(1)</script>"


_DRAWN = {}  # by how pictures are drawn and the bytes of an execution: many tests look at the same one


def drawn(execution):
    """Return the figures of an execution without truth, drawn once by each process."""
    key = FigureCanvasAgg.draw, hashlib.sha256(pickle.dumps(execution)).digest()
    if key not in _DRAWN:
        _DRAWN[key] = all_figures.draw_figures(execution, ErrorReport())
    return copy.deepcopy(_DRAWN[key])


def rendered(execution):
    return page.html(execution, ErrorReport(), drawn(execution))


def by_file(file, execution, report=None):
    """Return the rows of a table as its file has them."""
    (table,) = [one for one in all_tables.tables_of_run(execution, report or ErrorReport()) if one.file == file]
    return list(csv.DictReader(io.StringIO(csv_text(table))))


class TablesOfPage(HTMLParser):
    """Titles of tables, their cells, and every address that a browser would load."""

    def __init__(self, text):
        super().__init__()
        self.tables, self.addresses, self.tags = {}, [], []
        self._title, self._in = "", ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self._in = tag
        self.addresses += [v for k, v in attrs if k in ("src", "href", "data", "action", "srcset", "background")]
        if tag == "h3":
            self._title = ""
        if tag == "tr":
            self.tables.setdefault(self._title, []).append([])
        if tag in ("td", "th"):
            self.tables[self._title][-1].append("")

    def handle_data(self, data):
        if self._in == "h3":
            self._title += data
        if self._in in ("td", "th"):
            self.tables[self._title][-1][-1] += data

    def handle_endtag(self, tag):
        self._in = ""


class Page(TablesOfPage):
    """Also the scripts by their type, and all text outside them."""

    def __init__(self, text):
        self.scripts, self.text = [], ""
        super().__init__(text)

    def handle_starttag(self, tag, attrs):
        super().handle_starttag(tag, attrs)
        if tag == "script":
            self.scripts.append([dict(attrs).get("type", ""), ""])

    def handle_data(self, data):
        super().handle_data(data)
        if self._in == "script":
            self.scripts[-1][1] += data
        else:
            self.text += data
