"""How a simulated knee looks: drawn from what arthroscopes show, instead of the plain renders."""
