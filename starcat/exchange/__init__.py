"""Tables in the formats that astronomers use, and star tables of other tools."""
