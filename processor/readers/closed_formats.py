"""Closed formats, which only the software of their makers reads, and how to export scans from them."""

from __future__ import annotations

_FARO = ("FARO", "SCENE: right-click the scans, Import/Export, Export Scan Points")
_ZF = ("Zoller + Froehlich", "Z+F LaserControl: File, Export")
_RIEGL = ("RIEGL", "RiSCAN PRO: right-click the scan positions, Export")
_RECAP = ("Autodesk", "ReCap: Export")
_LEICA = ("Leica", "Cyclone or Cyclone REGISTER 360: Export")
_TRIMBLE = ("Trimble", "RealWorks: File, Export")
_DOT = ("DotProduct", "Dot3D: Export")
_TOPCON = ("Topcon", "ScanMaster or MAGNET Collage: Export")

FORMATS = {
    **dict.fromkeys((".fls", ".fws", ".lsproj"), _FARO),
    **dict.fromkeys((".zfs", ".zfprj"), _ZF),
    **dict.fromkeys((".rxp", ".rdb", ".rdbx", ".3dd"), _RIEGL),
    **dict.fromkeys((".rcp", ".rcs"), _RECAP),
    **dict.fromkeys((".imp", ".lgs", ".lgsx", ".b2g", ".blk"), _LEICA),
    **dict.fromkeys((".tzf", ".tzs", ".rwp"), _TRIMBLE),
    ".dp": _DOT,
    **dict.fromkeys((".cl3", ".clr"), _TOPCON),
}
ARCHIVES = (".zip", ".7z", ".rar", ".gz", ".tar", ".tgz")


def advice(suffix: str) -> str:
    """Return the maker of a format of FORMATS and how to export a scan from it."""
    maker, menu = FORMATS[suffix]
    return (
        f"expected an open format, found {suffix}, which only software of its maker ({maker}) reads; export the scan "
        f"to E57 there ({menu}), unmerged and with scanner positions, and give the E57 file instead"
    )
