"""The stereo laboratory: images, front-end and sensor models, on the bench and the referee."""
