"""Looking at recordings and simulations: pictures, videos, sliders in a browser.

- `pictures`: contact sheets and videos of a recording. `video_writer`: MP4 or GIF.
- `subject`: what a page with sliders simulates. `page`: what is seen.
"""
