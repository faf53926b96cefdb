"""The arthroscope's image: field of view, instruments and glare."""
