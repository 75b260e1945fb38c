"""Imported STEP and IFC files: ``files``, then ``process`` in a child process, then ``step`` and ``ifc``."""
