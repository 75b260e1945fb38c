"""Coarse registration: candidate poses of pairs (rotations, translations), their scores, the placing of all scans."""
