"""What a run or a comparison leaves on disk: folders, and all that is written into them."""
