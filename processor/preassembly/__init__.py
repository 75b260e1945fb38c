"""Virtual preassembly of arch bridges from scans of their parts."""
