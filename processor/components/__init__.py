"""The components of bridges and frames as structures of their own, for the steps that compare surfaces."""
