//! Our simulator in the place of DonkeySim, for tests of either side.

use std::net::SocketAddr;

use steersman::donkeysim::{DonkeySimOptions, DonkeySimServer, Reading, Scene};
use steersman::observer::StopSignal;
use steersman::simulator::Track;

/// Runs `test` against our simulator in the place of DonkeySim, on `lake`; the notices to its user are the result.
pub fn with_stand_in(scene: Scene, reading: Reading, test: impl FnOnce(SocketAddr)) -> Vec<String> {
    let address = SocketAddr::from(([127, 0, 0, 1], 0));
    let server = DonkeySimServer::bind(DonkeySimOptions { address, scene, reading, seed: 1, car: None }).unwrap();
    let (address, stop, track) = (server.address().unwrap(), StopSignal::default(), Track::load("lake").unwrap());
    let mut said = Vec::new();
    std::thread::scope(|scope| {
        let (said, stop, track) = (&mut said, &stop, &track);
        let running = scope.spawn(move || {
            let mut say = |text: String| {
                said.push(text);
                Ok(())
            };
            server.run(track, &mut say, stop).unwrap()
        });
        let tested = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| test(address)));
        stop.request();
        running.join().unwrap();
        if let Err(panic) = tested {
            std::panic::resume_unwind(panic);
        }
    });
    said
}
