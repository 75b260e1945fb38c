"""Members as tubes and nodes where they meet: linearity -> segments -> tube_fits -> junctions -> axis_intersection."""
