"""Members as tubes and nodes where they meet: voxel_linearity, voxel_lines, tube_fits, junctions, axis_intersection."""
