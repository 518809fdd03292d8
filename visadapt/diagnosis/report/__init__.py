"""What a diagnosis says, in words and figures."""
