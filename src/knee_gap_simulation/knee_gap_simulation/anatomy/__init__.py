"""A knee of surface meshes, as segmented from images of a person: read, posed, and met by rays."""
