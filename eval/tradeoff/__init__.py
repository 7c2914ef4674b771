"""What quality costs: denoisers, precisions and samples a pixel against milliseconds."""
