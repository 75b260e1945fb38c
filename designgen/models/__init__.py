"""Models to scan: CAD files, meshes and CadQuery objects. Read ``model``, then ``loading``, then ``as_built``."""
