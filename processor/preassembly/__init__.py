"""The parts of virtual preassembly: attitude, features, matching, errors."""
