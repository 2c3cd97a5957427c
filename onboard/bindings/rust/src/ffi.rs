// SPDX-License-Identifier: MIT
// The C library as it is; build.rs writes the limits in. `starcat.h` says what each field is.

pub const MAX_CENTROIDS: usize = 1000001;
pub const MAX_STARS: usize = 1000002;

// Of starcat_status.
pub const OK: i32 = 0;
pub const IDENTIFIED: i32 = 0;
pub const E_CRC: i32 = -8;
pub const E_CAPACITY: i32 = -9;

#[cfg(feature = "single")]
pub type Real = f32;
#[cfg(not(feature = "single"))]
pub type Real = f64;

#[repr(C)]
#[derive(Clone)]
pub struct Image {
    pub bytes: *const u8,
    pub total_bytes: u32,
    pub numbers: [u32; 8],
    pub scales: [Real; 8],
    pub sections: [*const u8; 9],
    pub neighbours: *const Neighbours,
}

/// A neighbour of a star, in small units; `starcat_neighbour` of C.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Neighbour {
    apart: u16,
    turn: u8,
    magnitude: u8,
}

#[repr(C)]
pub struct Neighbours {
    pub radius_rad: Real,
    pub capacity: u32,
    pub n_stars: u32,
    pub first: *mut u32,
    pub neighbour: *mut Neighbour,
}

/// A camera with square pixels; Brown's distortion as in OpenCV.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Camera {
    pub width_px: Real,
    pub height_px: Real,
    pub focal_length_px: Real,
    pub x0_px: Real,
    pub y0_px: Real,
    pub k1: Real,
    pub k2: Real,
    pub k3: Real,
    pub p1: Real,
    pub p2: Real,
    /// Largest x/z that the distortion holds for; 0: any.
    pub fold_radius: Real,
}

/// What is known of the frames, and what is accepted as an answer.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// Largest error of a centroid, as a radius; 3 times `noise_px` where that is stated.
    pub tolerance_px: Real,
    /// Standard deviation of a centroid on each axis; 0: not stated.
    pub noise_px: Real,
    /// Standard deviation of magnitudes; 0: not stated.
    pub noise_mag: Real,
    /// Natural logarithm of the largest probability that chance agrees as well.
    pub log_chance: Real,
    /// Largest relative error of the focal length, which is then found too.
    pub fov_error: Real,
    /// Largest error of a calibrated camera at the corners, as a share of the half diagonal; 0: not
    /// stated.
    pub camera_error: Real,
    /// Bound on the work.
    pub max_steps: u32,
}

#[repr(C)]
pub struct Frame {
    pub count: u32,
    pub x_px: *const Real,
    pub y_px: *const Real,
    pub magnitudes: *const Real,
    pub sigma_px: *const Real,
}

#[repr(C)]
#[derive(Clone)]
pub struct Found {
    pub q_body_from_icrs: [Real; 4],
    pub matrix: [Real; 9],
    pub residual_rad: Real,
    pub log_chance: Real,
    pub n_matched: u32,
    pub steps: u32,
    pub n_tried: u32,
    pub focal_length_px: Real,
    pub reason: u32,
    pub n_usable: u32,
    pub best_n_matched: u32,
    pub best_log_chance: Real,
    pub best_share: Real,
    pub covariance_rad2: [Real; 9],
    pub reduced_chi_square: Real,
    pub shape: [Real; 6],
    pub n_shape: u32,
    pub star: [i32; MAX_CENTROIDS],
}

const REAL: usize = core::mem::size_of::<Real>();
// Bytes of starcat_workspace, or a few more; starcat_crate_sizes says how many it has.
const WORKSPACE: usize = 10_496
    + 600 * REAL
    + MAX_CENTROIDS * (72 + 23 * REAL)
    + MAX_STARS * (8 + 6 * REAL);
pub const WORDS: usize = WORKSPACE / 8 + 1;

extern "C" {
    pub static starcat_crate_sizes: [u32; 10];
    pub fn starcat_version_number() -> u32;
    pub fn starcat_scrub_image(bytes: *const u8, size: usize, first: u32, count: u32, bad: *mut u32) -> i32;
    #[link_name = "starcat_open_image@SUFFIX@"]
    pub fn starcat_open_image(image: *mut Image, bytes: *const u8, size: usize, flags: u32) -> i32;
    #[link_name = "starcat_get_camera@SUFFIX@"]
    pub fn starcat_get_camera(image: *const Image, camera: *mut Camera) -> i32;
    #[link_name = "starcat_set_default_options@SUFFIX@"]
    pub fn starcat_set_default_options(options: *mut Options) -> i32;
    #[link_name = "starcat_list_neighbours@SUFFIX@"]
    pub fn starcat_list_neighbours(image: *const Image, work: *mut u64, table: *mut Neighbours) -> i32;
    #[link_name = "starcat_identify_frame@SUFFIX@"]
    pub fn starcat_identify_frame(
        image: *const Image,
        camera: *const Camera,
        options: *const Options,
        frame: *const Frame,
        work: *mut u64,
        found: *mut Found,
    ) -> i32;
    #[link_name = "starcat_track_frame@SUFFIX@"]
    pub fn starcat_track_frame(
        image: *const Image,
        camera: *const Camera,
        options: *const Options,
        frame: *const Frame,
        q_prior: *const Real,
        uncertainty_rad: Real,
        work: *mut u64,
        found: *mut Found,
    ) -> i32;
    #[link_name = "starcat_fit_attitude@SUFFIX@"]
    pub fn starcat_fit_attitude(
        body: *const [Real; 3],
        icrs: *const [Real; 3],
        count: u32,
        q: *mut Real,
    ) -> i32;
}
