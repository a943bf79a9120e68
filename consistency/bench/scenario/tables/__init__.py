"""What the tables of a scenario's file are made of: the types of their keys, and the keys of every sensor."""
