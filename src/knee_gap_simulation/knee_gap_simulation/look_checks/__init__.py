"""Commands to look at the looks of the knee: a contact sheet, and a comparison with real pictures."""
