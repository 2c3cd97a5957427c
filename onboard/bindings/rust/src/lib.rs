// SPDX-License-Identifier: MIT
//! Identifies the stars of a star tracker's frame with an image of a guide-star database. The C
//! library `starcat onboard` does it; this crate compiles its two-file amalgamation and needs nothing
//! else: no heap, no standard library, no other crate.
//!
//! ```no_run
//! use starcat_onboard::{Frame, Image, Matcher, Workspace};
//! # static FLASH: [u64; 4] = [0; 4];
//! let image = Image::open(&FLASH).expect("a sound image");
//! let mut work = Workspace::new(); // 37 kB: a static, on a small target
//! let mut matcher = Matcher::new(&image, &mut work);
//! matcher.options.noise_px = 0.3;
//! let (x_px, y_px) = ([100.0, 200.0, 300.0, 150.0], [50.0, 90.0, 40.0, 400.0]);
//! let answer = matcher.identify(&Frame::new(&x_px, &y_px)).expect("an attitude");
//! println!("{:?} {:?}", answer.quaternion(), image.star_ids()[answer.rows()[0] as usize]);
//! ```
//!
//! Whatever the bytes are, opening them is safe; damaged ones are refused:
//!
//! ```
//! use starcat_onboard::{Error, Image};
//! assert_eq!(Image::open(&[0; 64]).err(), Some(Error::NoImage));
//! assert_eq!(Image::open(&[0; 3]).err(), Some(Error::Short));
//! ```
#![no_std]
#![warn(missing_docs)]

#[allow(missing_docs)]
mod ffi {
    include!(concat!(env!("OUT_DIR"), "/ffi.rs"));
}

use core::marker::PhantomData;
use core::mem::{size_of, size_of_val, MaybeUninit};
use core::ptr;

pub use ffi::{Camera, Neighbour, Options, Real, MAX_CENTROIDS, MAX_STARS};

/// Why there is no answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Error {
    /// No attitude explains the frame beyond chance.
    NoMatch(Reason),
    /// Fewer than four usable centroids, or than two different directions.
    TooFewStars,
    /// Fewer bytes than a header, or than it says.
    Short,
    /// The bytes are no image.
    NoImage,
    /// A major version of the format that the library does not read.
    Version,
    /// An image for the other byte order.
    ByteOrder,
    /// Sizes or sections that contradict each other.
    Layout,
    /// A block is damaged, the first one so.
    Damaged(u32),
    /// More stars in a field than `MAX_STARS`.
    Capacity,
    /// More centroids than `MAX_CENTROIDS`.
    TooManyCentroids,
    /// An option, the prior or a direction is not finite.
    NotFinite,
    /// A camera that cannot be.
    Camera,
    /// An option or a prior out of range.
    Options,
    /// The steps were used up.
    Budget,
    /// Arrays of one frame have different lengths.
    Lengths,
    /// The C library was compiled otherwise than this crate takes it to be.
    Configuration,
}

/// Why a frame has no match.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Reason {
    /// No pattern of the frame is in the image.
    NoCandidate,
    /// No attitude fits better than chance.
    Chance,
    /// The best agreement does not determine the whole frame.
    Share,
    /// The scale or the shape of the frame is out of range.
    Scale,
}

impl core::fmt::Display for Error {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let said = match self {
            Error::NoMatch(reason) => return write!(f, "no match: {reason:?}"),
            Error::Damaged(block) => return write!(f, "block {block} of the image is damaged"),
            Error::TooFewStars => "too few centroids or directions",
            Error::Short => "fewer bytes than the image has",
            Error::NoImage => "not an image of starcat",
            Error::Version => "an image of another version of the format",
            Error::ByteOrder => "an image for the other byte order",
            Error::Layout => "sizes of the image contradict each other",
            Error::Capacity => "more stars in a field than MAX_STARS",
            Error::TooManyCentroids => "more centroids than MAX_CENTROIDS",
            Error::NotFinite => "a number is not finite",
            Error::Camera => "a camera that cannot be",
            Error::Options => "an option or a prior out of range",
            Error::Budget => "the steps are used up",
            Error::Lengths => "arrays of different lengths",
            Error::Configuration => "the C library was compiled with other limits",
        };
        f.write_str(said)
    }
}

impl core::error::Error for Error {}

/// What a status is an error for; of a null pointer and of alignment there is none from here.
fn failed(status: i32, reason: u32) -> Error {
    match (status, reason) {
        (1, 2) => Error::NoMatch(Reason::NoCandidate),
        (1, 4) => Error::NoMatch(Reason::Share),
        (1, 5) => Error::NoMatch(Reason::Scale),
        (1, _) => Error::NoMatch(Reason::Chance),
        (2, _) => Error::TooFewStars,
        (-2, _) => Error::Short,
        (-3, _) => Error::NoImage,
        (-4, _) => Error::Version,
        (-5, _) => Error::ByteOrder,
        (-8, block) => Error::Damaged(block),
        (-9, _) => Error::Capacity,
        (-10, _) => Error::TooManyCentroids,
        (-11, _) => Error::NotFinite,
        (-12, _) => Error::Camera,
        (-13, _) => Error::Options,
        (-14, _) => Error::Budget,
        _ => Error::Layout,
    }
}

/// The library's version: 10000 times the major one, plus 100 times the minor one, plus the patch.
///
/// ```
/// assert!(starcat_onboard::version_number() >= 200);
/// ```
pub fn version_number() -> u32 {
    // SAFETY: it takes nothing and returns a number.
    unsafe { ffi::starcat_version_number() }
}

/// Check blocks `first` to `first + count` of an image, every block if `count` is 0.
pub fn scrub(words: &[u64], first: u32, count: u32) -> Result<(), Error> {
    let mut bad = 0;
    // SAFETY: the library reads no more than the bytes that it is told of.
    let status = unsafe {
        ffi::starcat_scrub_image(words.as_ptr().cast(), size_of_val(words), first, count, &mut bad)
    };
    if status == ffi::OK {
        Ok(())
    } else {
        Err(failed(status, bad))
    }
}

/// An image, opened where it lies.
#[repr(transparent)]
#[derive(Clone)]
pub struct Image<'a> {
    raw: ffi::Image,
    words: PhantomData<&'a [u64]>,
}

// SAFETY: it is never changed, and neither are the words that it points into.
unsafe impl Send for Image<'_> {}
// SAFETY: the same.
unsafe impl Sync for Image<'_> {}

impl<'a> Image<'a> {
    /// Open an image: check its header, its sizes and every CRC.
    pub fn open(words: &'a [u64]) -> Result<Self, Error> {
        // SAFETY: a constant of the library.
        let sizes = unsafe { ffi::starcat_crate_sizes };
        let expected = [
            size_of::<ffi::Image>(),
            size_of::<Camera>(),
            size_of::<Options>(),
            size_of::<ffi::Frame>(),
            size_of::<ffi::Found>(),
        ];
        let is_same = expected.iter().zip(sizes).all(|(ours, theirs)| *ours == theirs as usize);
        let is_same = is_same && size_of::<ffi::Neighbours>() == sizes[6] as usize;
        let found = MaybeUninit::<ffi::Found>::uninit();
        let start = found.as_ptr();
        // SAFETY: only the addresses of the fields are used.
        let offsets = unsafe {
            [
                ptr::addr_of!((*start).covariance_rad2) as usize,
                ptr::addr_of!((*start).n_shape) as usize,
                ptr::addr_of!((*start).star) as usize,
            ]
        };
        let is_same = is_same
            && offsets
                .iter()
                .zip(&sizes[7..])
                .all(|(ours, theirs)| *ours - start as usize == *theirs as usize);
        if !is_same || size_of::<Workspace>() < sizes[5] as usize {
            return Err(Error::Configuration);
        }
        let mut raw = MaybeUninit::uninit();
        // SAFETY: the words are aligned by 8 and live as long as the image; the library reads no more
        // than the bytes that it is told of.
        let status = unsafe {
            ffi::starcat_open_image(raw.as_mut_ptr(), words.as_ptr().cast(), size_of_val(words), 0)
        };
        match status {
            // SAFETY: the library has filled it in.
            ffi::OK => Ok(Image { raw: unsafe { raw.assume_init() }, words: PhantomData }),
            ffi::E_CRC => Err(scrub(words, 0, 0).err().unwrap_or(Error::Layout)),
            _ => Err(failed(status, 0)),
        }
    }

    /// Number of stars.
    pub fn n_stars(&self) -> usize {
        self.raw.numbers[2] as usize
    }

    /// Ids of the stars, by row.
    pub fn star_ids(&self) -> &'a [i64] {
        // SAFETY: starcat_open_image has checked that the section has so many, and it is aligned by 64.
        unsafe { core::slice::from_raw_parts(self.raw.sections[2].cast(), self.n_stars()) }
    }

    /// Name and version of the database.
    pub fn name(&self) -> &'a str {
        // SAFETY: 96 bytes of the header.
        let bytes = unsafe { core::slice::from_raw_parts(self.raw.sections[7], 96) };
        let end = bytes.iter().position(|byte| *byte == 0).unwrap_or(96);
        core::str::from_utf8(&bytes[..end]).unwrap_or("")
    }

    /// The camera that the image was built for, to be calibrated.
    pub fn camera(&self) -> Camera {
        let mut camera = Camera::default();
        // SAFETY: both are sound.
        let _ = unsafe { ffi::starcat_get_camera(&self.raw, &mut camera) };
        camera
    }
}

/// The neighbours of every star of an image, in memory of the caller. With them frames that
/// triangles do not solve are solved by votes: [`Matcher::with_neighbours`].
pub struct Neighbours<'a> {
    raw: ffi::Neighbours,
    memory: PhantomData<&'a mut [Neighbour]>,
}

// SAFETY: it is never changed after it was made, and it alone has the memory.
unsafe impl Send for Neighbours<'_> {}
// SAFETY: the same.
unsafe impl Sync for Neighbours<'_> {}

impl<'a> Neighbours<'a> {
    /// The number of neighbours that [`Neighbours::list`] needs memory for. `first` needs one number
    /// more than the image has stars.
    pub fn count(
        image: &Image<'_>,
        radius_rad: Real,
        first: &mut [u32],
        work: &mut Workspace,
    ) -> Result<usize, Error> {
        let stop = image.n_stars();
        match Self::fill(image, radius_rad, first, &mut [], work) {
            Ok(_) => Ok(0),
            Err(Error::Capacity) if first[stop] > 0 => Ok(first[stop] as usize),
            Err(error) => Err(error),
        }
    }

    /// List the neighbours of every star within a radius, about half of the diagonal of the field.
    pub fn list(
        image: &Image<'_>,
        radius_rad: Real,
        first: &'a mut [u32],
        memory: &'a mut [Neighbour],
        work: &mut Workspace,
    ) -> Result<Self, Error> {
        let raw = Self::fill(image, radius_rad, first, memory, work)?;
        Ok(Neighbours { raw, memory: PhantomData })
    }

    fn fill(
        image: &Image<'_>,
        radius_rad: Real,
        first: &mut [u32],
        memory: &mut [Neighbour],
        work: &mut Workspace,
    ) -> Result<ffi::Neighbours, Error> {
        if first.len() <= image.n_stars() {
            return Err(Error::Lengths);
        }
        let mut raw = ffi::Neighbours {
            radius_rad,
            capacity: u32::try_from(memory.len()).unwrap_or(u32::MAX),
            n_stars: 0,
            first: first.as_mut_ptr(),
            neighbour: memory.as_mut_ptr(),
        };
        // SAFETY: `first` is long enough, `memory` has `capacity` neighbours, and Workspace is large
        // enough, which Image::open has checked.
        let status =
            unsafe { ffi::starcat_list_neighbours(&image.raw, work.0.as_mut_ptr(), &mut raw) };
        match status {
            ffi::OK => Ok(raw),
            ffi::E_CAPACITY => Err(Error::Capacity),
            _ => Err(failed(status, 0)),
        }
    }
}

impl Default for Options {
    /// 2 px, a chance below 1e-9, 4,000,000 steps.
    fn default() -> Self {
        let mut options = MaybeUninit::uninit();
        // SAFETY: the library fills it in.
        unsafe {
            let _ = ffi::starcat_set_default_options(options.as_mut_ptr());
            options.assume_init()
        }
    }
}

/// Memory that a call works in, for one at a time.
pub struct Workspace([u64; ffi::WORDS]);

impl Workspace {
    /// Memory, all zeros; it may be the value of a static.
    pub const fn new() -> Self {
        Workspace([0; ffi::WORDS])
    }
}

impl Default for Workspace {
    fn default() -> Self {
        Self::new()
    }
}

/// The centroids of a frame. Pixels from the outer corner of the top-left one, x right, y down.
#[derive(Clone, Copy, Debug)]
pub struct Frame<'f> {
    /// Column of each centroid.
    pub x_px: &'f [Real],
    /// Row of each centroid.
    pub y_px: &'f [Real],
    /// Magnitudes, NaN where unknown.
    pub magnitudes: Option<&'f [Real]>,
    /// Standard deviation on each axis, NaN where unknown.
    pub sigma_px: Option<&'f [Real]>,
}

impl<'f> Frame<'f> {
    /// Centroids of unknown brightness and noise.
    pub fn new(x_px: &'f [Real], y_px: &'f [Real]) -> Self {
        Frame { x_px, y_px, magnitudes: None, sigma_px: None }
    }

    fn raw(&self) -> Result<ffi::Frame, Error> {
        let count = self.x_px.len();
        let fits = |given: Option<&[Real]>| given.map_or(true, |array| array.len() == count);
        if self.y_px.len() != count || !fits(self.magnitudes) || !fits(self.sigma_px) {
            return Err(Error::Lengths);
        }
        if count > MAX_CENTROIDS {
            return Err(Error::TooManyCentroids);
        }
        let address = |given: Option<&[Real]>| given.map_or(ptr::null(), <[Real]>::as_ptr);
        Ok(ffi::Frame {
            count: count as u32,
            x_px: self.x_px.as_ptr(),
            y_px: self.y_px.as_ptr(),
            magnitudes: address(self.magnitudes),
            sigma_px: address(self.sigma_px),
        })
    }
}

/// What identifies frames with an image. Change camera and options at will.
pub struct Matcher<'a> {
    raw: ffi::Image, // of the caller's image, with its neighbours
    image: PhantomData<&'a Image<'a>>,
    work: &'a mut Workspace,
    found: ffi::Found,
    /// The camera: at first the one that the image was built for.
    pub camera: Camera,
    /// The options: at first the default ones.
    pub options: Options,
}

impl<'a> Matcher<'a> {
    /// A matcher for the camera that the image was built for.
    pub fn new(image: &'a Image<'a>, work: &'a mut Workspace) -> Self {
        // SAFETY: numbers, for all of which zero is a value.
        let found = unsafe { MaybeUninit::zeroed().assume_init() };
        let (raw, camera, options) = (image.raw.clone(), image.camera(), Options::default());
        Matcher { raw, image: PhantomData, work, found, camera, options }
    }

    /// The same matcher, which solves frames by votes if triangles do not solve them. Neighbours of an
    /// image with another number of stars are not used.
    #[must_use]
    pub fn with_neighbours(mut self, neighbours: &'a Neighbours<'a>) -> Self {
        self.raw.neighbours = &neighbours.raw;
        self
    }

    /// Identify the stars of a frame without any prior knowledge.
    pub fn identify(&mut self, frame: &Frame<'_>) -> Result<Answer<'_>, Error> {
        let raw = frame.raw()?;
        // SAFETY: the arrays have `count` numbers; Workspace is large enough, which Image::open has
        // checked, and aligned by 8.
        let status = unsafe {
            ffi::starcat_identify_frame(
                &self.raw,
                &self.camera,
                &self.options,
                &raw,
                self.work.0.as_mut_ptr(),
                &mut self.found,
            )
        };
        self.answer(status, raw.count)
    }

    /// Identify the stars of a frame near a prior attitude, wrong by at most so much, up to 0.35 rad.
    pub fn track(
        &mut self,
        frame: &Frame<'_>,
        q_prior: &[Real; 4],
        uncertainty_rad: Real,
    ) -> Result<Answer<'_>, Error> {
        let raw = frame.raw()?;
        // SAFETY: as above.
        let status = unsafe {
            ffi::starcat_track_frame(
                &self.raw,
                &self.camera,
                &self.options,
                &raw,
                q_prior.as_ptr(),
                uncertainty_rad,
                self.work.0.as_mut_ptr(),
                &mut self.found,
            )
        };
        self.answer(status, raw.count)
    }

    fn answer(&self, status: i32, count: u32) -> Result<Answer<'_>, Error> {
        if status == ffi::IDENTIFIED {
            Ok(Answer { found: &self.found, count: count as usize })
        } else {
            Err(failed(status, self.found.reason))
        }
    }
}

/// An attitude, and which star each centroid is.
#[derive(Clone, Copy)]
pub struct Answer<'m> {
    found: &'m ffi::Found,
    count: usize,
}

impl<'m> Answer<'m> {
    /// The attitude as [x, y, z, w], scalar last and w >= 0. It stands for the matrix that `matrix`
    /// returns; the head of `starcat.h` has the formula and an example. It is the conjugate of the
    /// quaternion that `nalgebra` and other libraries of Hamilton's convention have for this matrix.
    pub fn quaternion(&self) -> [Real; 4] {
        self.found.q_body_from_icrs
    }

    /// The same attitude by rows: it converts ICRS components into camera components,
    /// camera = matrix * icrs.
    pub fn matrix(&self) -> &'m [Real; 9] {
        &self.found.matrix
    }

    /// Row in the image of each centroid's star; -1: none, below: not used.
    pub fn rows(&self) -> &'m [i32] {
        &self.found.star[..self.count]
    }

    /// Root mean square of the matched centroids, radians.
    pub fn residual_rad(&self) -> Real {
        self.found.residual_rad
    }

    /// Natural logarithm of the bound on the probability that chance agrees as well.
    pub fn log_chance(&self) -> Real {
        self.found.log_chance
    }

    /// How many centroids are stars.
    pub fn n_matched(&self) -> usize {
        self.found.n_matched as usize
    }

    /// Steps that were taken.
    pub fn steps(&self) -> u32 {
        self.found.steps
    }

    /// The given focal length, or the one that was found.
    pub fn focal_length_px(&self) -> Real {
        self.found.focal_length_px
    }

    /// How the frame differs from the camera: 0 (the scale is in the focal length), radial, stretch,
    /// shear, tilt in x and y. All zeros: it has the shape of the camera.
    pub fn shape(&self) -> &'m [Real; 6] {
        &self.found.shape
    }

    /// Number of terms of the shape that were fitted.
    pub fn n_shape(&self) -> usize {
        self.found.n_shape as usize
    }

    /// Covariance of small turns about the camera's axes, by rows.
    pub fn covariance_rad2(&self) -> &'m [Real; 9] {
        &self.found.covariance_rad2
    }

    /// Squared residuals in the stated noise, a degree of freedom; 0: not stated.
    pub fn reduced_chi_square(&self) -> Real {
        self.found.reduced_chi_square
    }
}

/// Find the rotation that best turns directions of ICRS into those of the camera.
///
/// ```
/// let x = [1.0, 0.0, 0.0];
/// let y = [0.0, 1.0, 0.0];
/// let q = starcat_onboard::attitude(&[x, y], &[x, y]).unwrap();
/// assert!((q[3] - 1.0).abs() < 1e-6);
/// ```
pub fn attitude(body: &[[Real; 3]], icrs: &[[Real; 3]]) -> Result<[Real; 4], Error> {
    if body.len() != icrs.len() {
        return Err(Error::Lengths);
    }
    let count = u32::try_from(body.len()).map_err(|_| Error::Lengths)?;
    let mut q = [0.0; 4];
    // SAFETY: both have `count` rows.
    let status =
        unsafe { ffi::starcat_fit_attitude(body.as_ptr(), icrs.as_ptr(), count, q.as_mut_ptr()) };
    if status == ffi::OK {
        Ok(q)
    } else {
        Err(failed(status, 0))
    }
}
