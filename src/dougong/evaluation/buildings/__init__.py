"""The five generated buildings, and the parts they are put together from."""
