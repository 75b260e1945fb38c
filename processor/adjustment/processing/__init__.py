"""What software has done to points between the scanner and the file."""
