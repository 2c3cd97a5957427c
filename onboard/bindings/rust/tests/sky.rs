// SPDX-License-Identifier: MIT
//! Frames of the made-up sky that the unit test of C looks at, too.

use starcat_onboard::{
    Camera, Error, Frame, Image, Matcher, Neighbour, Neighbours, Real, Workspace, MAX_CENTROIDS,
};

#[repr(C)]
struct Recipe {
    method: u32,
    index_bytes: u32,
    n_stars: u32,
    longest_rad: f64,
    seed: u64,
}

#[repr(C)]
struct Truth {
    count: u32,
    x: [Real; MAX_CENTROIDS],
    y: [Real; MAX_CENTROIDS],
    magnitudes: [Real; MAX_CENTROIDS],
    star: [i32; MAX_CENTROIDS],
    matrix: [f64; 9],
    q_body_from_icrs: [Real; 4],
}

extern "C" {
    fn sky_image(recipe: *const Recipe, bytes: *mut u64) -> usize;
    fn sky_look(
        image: *const Image,
        camera: *const Camera,
        state: *mut u64,
        noise_px: f64,
        n_spots: u32,
        n_false: u32,
        frame: *mut Truth,
    );
}

fn sky(method: u32) -> Vec<u64> {
    static ONE: std::sync::Mutex<()> = std::sync::Mutex::new(());
    let _held = ONE.lock();
    let longest_rad = if method == 1 { 0.42 } else { 0.698 };
    let recipe = Recipe { method, index_bytes: 2 * method, n_stars: 300, longest_rad, seed: 8 };
    let mut words = vec![0; 600_000 / 8];
    let size = unsafe { sky_image(&recipe, words.as_mut_ptr()) };
    words.truncate(size / 8);
    words
}

/// Image is what C has and nothing else, so that its address is that of C's.
fn look(image: &Image, camera: &Camera, seed: u64) -> Truth {
    let mut truth = unsafe { std::mem::zeroed() };
    let mut state = seed;
    unsafe { sky_look(image, camera, &mut state, 0.2, 12, 0, &mut truth) };
    truth
}

#[test]
fn frames_are_identified_and_tracked() {
    for method in 1..=2 {
        let words = sky(method);
        let image = Image::open(&words).unwrap();
        assert_eq!(
            (image.name(), image.n_stars(), image.star_ids().len()),
            ("sky-1.0.0", 300, 300)
        );
        let mut work = Workspace::new();
        let mut matcher = Matcher::new(&image, &mut work);
        let mut found = 0;
        for seed in 0..50 {
            let truth = look(&image, &matcher.camera, seed);
            let count = truth.count as usize;
            let mut frame = Frame::new(&truth.x[..count], &truth.y[..count]);
            frame.magnitudes = Some(&truth.magnitudes[..count]);
            if let Ok(answer) = matcher.identify(&frame) {
                assert_eq!(answer.rows(), &truth.star[..count]);
                assert!((answer.quaternion()[3] - truth.q_body_from_icrs[3]).abs() < 0.01);
                assert!(answer.log_chance() <= -20.0 && answer.n_matched() == count);
                found += 1;
            }
            let tracked = matcher.track(&frame, &truth.q_body_from_icrs, 0.01).unwrap();
            assert_eq!(tracked.rows(), &truth.star[..count]);
        }
        assert!(found >= 48, "{found}");
    }
}

#[test]
fn neighbours_are_listed() {
    let words = sky(1);
    let image = Image::open(&words).unwrap();
    let mut work = Workspace::new();
    let mut first = [0; 301];
    let short = Neighbours::count(&image, 0.475, &mut first[..300], &mut work);
    assert_eq!(short.err(), Some(Error::Lengths));
    let wide = Neighbours::count(&image, 2.0, &mut first, &mut work);
    assert_eq!(wide.err(), Some(Error::Options));
    let count = Neighbours::count(&image, 0.475, &mut first, &mut work).unwrap();
    assert!((3_000..10_000).contains(&count), "{count}");
    let mut memory = vec![Neighbour::default(); count];
    let less = Neighbours::list(&image, 0.475, &mut first, &mut memory[1..], &mut work);
    assert_eq!(less.err(), Some(Error::Capacity));
    let table = Neighbours::list(&image, 0.475, &mut first, &mut memory, &mut work).unwrap();
    let mut matcher = Matcher::new(&image, &mut work).with_neighbours(&table);
    let truth = look(&image, &matcher.camera, 4);
    let count = truth.count as usize;
    let answer = matcher.identify(&Frame::new(&truth.x[..count], &truth.y[..count])).unwrap();
    assert_eq!(answer.rows(), &truth.star[..count]);
    // Spots that are no stars: voted on, and refused.
    let x: Vec<Real> = (0..20).map(|n| (37 * n % 511) as Real).collect();
    let y: Vec<Real> = (0..20).map(|n| (101 * n % 509) as Real).collect();
    assert!(matcher.identify(&Frame::new(&x, &y)).is_err());
}

#[test]
fn mistakes_are_errors() {
    let mut words = sky(1);
    {
        let image = Image::open(&words).unwrap();
        let mut work = Workspace::new();
        let mut matcher = Matcher::new(&image, &mut work);
        let many = [1.0; MAX_CENTROIDS + 1];
        let identify = |matcher: &mut Matcher, x: &[Real], y: &[Real]| {
            matcher.identify(&Frame::new(x, y)).err()
        };
        assert_eq!(identify(&mut matcher, &many[..5], &many[..4]), Some(Error::Lengths));
        assert_eq!(identify(&mut matcher, &many, &many), Some(Error::TooManyCentroids));
        assert_eq!(identify(&mut matcher, &[], &[]), Some(Error::TooFewStars));
        matcher.options.tolerance_px = Real::NAN;
        assert_eq!(identify(&mut matcher, &many[..5], &many[..5]), Some(Error::NotFinite));
        matcher.options.tolerance_px = 2.0;
        matcher.camera.focal_length_px = 0.0;
        assert_eq!(identify(&mut matcher, &many[..5], &many[..5]), Some(Error::Camera));
    }
    words[1500] ^= 1 << 40;
    assert_eq!(Image::open(&words).err(), Some(Error::Damaged(2)));
    assert_eq!(starcat_onboard::scrub(&words, 0, 2), Ok(()));
    assert_eq!(Image::open(&words[..100]).err(), Some(Error::Short));
}
