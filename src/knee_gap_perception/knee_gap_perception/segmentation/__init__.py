"""Which pixels are the dark gap: strategies behind one Protocol, chosen by name."""
