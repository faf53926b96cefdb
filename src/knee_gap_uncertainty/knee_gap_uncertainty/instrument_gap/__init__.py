"""The instrument gap: its width at the section, its bounds and its profile."""
