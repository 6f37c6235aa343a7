"""Images, folders, videos and captures as input of landmark fits, and what is written about them."""
