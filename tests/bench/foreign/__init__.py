"""Scene generators apart from all others: each file is a script of its own, on NumPy alone.

They share no code with designgen, with the processor or with each other, so that an error of one model of steel or
scanner cannot cancel. ``python FILE FOLDER --seed N --set key=value`` writes a scan folder with its ``truth.json``.
"""
