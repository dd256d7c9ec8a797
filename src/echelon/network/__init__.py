"""Who hears whom, and where each belongs: graphs and formations."""
