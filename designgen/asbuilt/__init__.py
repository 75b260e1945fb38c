"""Components as built: ``imperfections`` of arch parts and space frames, ``defects`` of plates and displaced roofs."""
