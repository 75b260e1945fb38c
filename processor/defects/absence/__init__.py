"""Missing material in clouds whose stations are not named: no ray shows that a place was looked at."""
