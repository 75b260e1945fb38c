"""Triangle meshes: read from PLY, STL and OBJ files, polygons cut into triangles, faults mended; shared with designgen.

Read ``mesh_files``, then ``polygons``, then ``faults``.
"""
