"""Components in closed form and as CadQuery solids.

Read ``parametric_face`` and ``boxes_and_tubes`` first, then ``arch_part`` and ``bolt_ball``, then the structures made
of them.
"""
