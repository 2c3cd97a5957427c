/* The image, as the file that starcat export --to onboard writes, in flash. It begins at a multiple of
 * 64; 8 would do. SPDX-License-Identifier: MIT */
  .section .image, "a"
  .balign 64
  .global image_begin, image_end
image_begin:
  .incbin IMAGE
image_end:
