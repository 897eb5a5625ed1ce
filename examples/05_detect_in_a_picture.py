"""Find the lights in a picture: an array, out of a file or a camera."""

import sys

import buddyline
import cv2

for name in sys.argv[1:]:
    image = cv2.imread(name)
    if image is None:
        sys.exit(f"{name}: is no picture")
    for blob in buddyline.detect(image)[:4]:
        print(f"{name}: {blob.u_px:7.2f} {blob.v_px:7.2f} px, 1 sd {blob.sigma_px:.2f} px, peak {blob.peak:.0f}")
