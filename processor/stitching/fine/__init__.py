"""Fine registration: shared planes, bundle adjustment, checks. Read ``correspondences``, then ``bundle_adjustment``."""
