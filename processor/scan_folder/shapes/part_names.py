"""The direction in which the names of parts are numbered."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise

from processor.scan_folder.component_names import plain


def numbered_backwards(names: Sequence[str]) -> bool:
    """Whether the numbers of names in order fall wherever a word has several, and rise nowhere."""
    of_word = defaultdict(list)
    for name in names:
        match = re.search(r"(\d+)\D*$", plain(name))
        if match:
            of_word[plain(name)[: match.start()].strip(" _-.")].append(int(match[1]))
    steps = [b - a for numbers in of_word.values() for a, b in pairwise(numbers)]
    return bool(steps) and max(steps) < 0
