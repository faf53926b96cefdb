"""The paper's simulation study: its tables and figures from its parameters, as far as they can be had."""
