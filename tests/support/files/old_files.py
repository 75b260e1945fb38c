"""Files as earlier versions wrote them, or as somebody else might: without checksums."""

import h5py
import numpy as np

from processor.store import checksums, store


def without_checksums(path):
    """Turn a file into one of the version before checksums came; returns its path."""
    with h5py.File(path, "r+") as file:
        for _, dataset in list(checksums.datasets(file)):
            del dataset.attrs[checksums.ATTRIBUTE]
        del file.attrs[checksums.ATTRIBUTE]
        results = bytes(file.attrs["format"]) == store.FORMATS["results"].encode()
        del file.attrs["format_version"]
        file.attrs["format_version"] = np.bytes_("2.0" if results else "1.3")
    return path


def sealed_again(path):
    """Give a changed file the checksums of its new content, as somebody who wants to mislead would."""
    with h5py.File(path, "r+") as file:
        known = {}
        for place, dataset in list(checksums.datasets(file)):
            dataset.attrs.pop(checksums.ATTRIBUTE, None)
            known[place] = checksums.seal(dataset.id, place, array := checksums.whole(dataset), [array])
        file.attrs.pop(checksums.ATTRIBUTE, None)
        checksums.seal_root(file, known)
    return path
