"""Many recordings judged by one pipeline: a dataset of flights and events, and a page of what to look at."""
