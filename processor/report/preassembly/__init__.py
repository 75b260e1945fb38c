"""Report of the step preassemble."""
