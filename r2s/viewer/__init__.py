"""Looking at recordings and simulations: pictures and videos (`pictures`), sliders (`page`)."""
