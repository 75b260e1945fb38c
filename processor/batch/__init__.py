"""Many inputs below one folder: each a job in a process of its own, on this machine or on a cluster."""
