//! Which instruction set the numeric tests run on: printed for the gate, and checked against what was asked for.

use steersman_kernels::Isa;

/// `Isa::best` ignores a name in `STEERSMAN_ISA` that this processor does not have; a test run must not.
#[test]
fn the_instruction_set_asked_for_is_the_one_that_runs() {
    let names: Vec<&str> = Isa::available().iter().map(|isa| isa.name()).collect();
    let best = Isa::best().name();
    println!("instruction set: {best} of {}", names.join(" "));
    match std::env::var("STEERSMAN_ISA") {
        Ok(wanted) if !wanted.is_empty() => assert_eq!(best, wanted, "this processor has {names:?}"),
        _ => assert_eq!(Some(&best), names.last()),
    }
}
