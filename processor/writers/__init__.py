"""Point clouds in the file formats of scanners, written block by block in bounded memory."""
