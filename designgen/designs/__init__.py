"""Components in closed form and as CadQuery solids.

Read ``patch`` and ``box_and_tube`` first, then ``arch_part`` and ``bolt_ball``, then the structures made of them.
"""
