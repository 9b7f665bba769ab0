//! One step of an optimiser over a slice of parameters, and the sums that go with it.

/// The numbers of one step of [`adam`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdamStep {
    /// Learning rate of this step.
    pub lr: f32,
    /// Weight of the old value in the mean of the gradients.
    pub beta1: f32,
    /// Weight of the old value in the mean of the squared gradients.
    pub beta2: f32,
    /// Added to the square root of the mean square, outside the root.
    pub epsilon: f32,
    /// `1 - beta1^t` for the step number `t`, counted from 1.
    pub bias_correction1: f32,
    /// `1 - beta2^t`.
    pub bias_correction2: f32,
    /// L2 penalty: `l2 * p` is added to the gradient of `p`.
    pub l2: f32,
    /// Decoupled weight decay (AdamW): `lr * decoupled_decay * p` is subtracted from `p`.
    pub decoupled_decay: f32,
}

per_isa! {
    /// One step of Adam (Kingma and Ba 2014) in the form of Keras:
    ///
    /// ```text
    /// g  = grad + l2 p
    /// m  = beta1 m + (1 - beta1) g
    /// v  = beta2 v + (1 - beta2) g²
    /// p -= lr decoupled_decay p + lr sqrt(bias_correction2) / bias_correction1 * m / (sqrt(v) + epsilon)
    /// ```
    ///
    /// `m` and `v` start at 0. Epsilon stands outside the root and beside the uncorrected `v` (section 2 of the paper).
    pub fn adam<S>(_simd: S, step: &AdamStep, params: &mut [f32], grads: &[f32], m: &mut [f32], v: &mut [f32]) {
        let len = params.len();
        assert!(grads.len() == len && m.len() == len && v.len() == len, "adam: the slices differ in length");
        let AdamStep { lr, beta1, beta2, epsilon, bias_correction1, bias_correction2, l2, decoupled_decay } = *step;
        let rate = lr * bias_correction2.sqrt() / bias_correction1;
        let decay = lr * decoupled_decay;
        for (((p, &g), m), v) in params.iter_mut().zip(grads).zip(m).zip(v) {
            let g = g + l2 * *p;
            *m = beta1 * *m + (1.0 - beta1) * g;
            *v = beta2 * *v + (1.0 - beta2) * (g * g);
            *p -= decay * *p + rate * *m / (v.sqrt() + epsilon);
        }
    }
}

per_isa! {
    /// One step of gradient descent with momentum: `velocity = momentum * velocity - lr * (grad + l2 * p)`,
    /// `p += velocity`. A momentum of 0 is plain gradient descent.
    pub fn sgd_momentum<S>(
        _simd: S,
        lr: f32,
        momentum: f32,
        l2: f32,
        params: &mut [f32],
        grads: &[f32],
        velocity: &mut [f32],
    ) {
        let len = params.len();
        assert!(grads.len() == len && velocity.len() == len, "sgd_momentum: the slices differ in length");
        for ((p, &g), velocity) in params.iter_mut().zip(grads).zip(velocity) {
            *velocity = momentum * *velocity - lr * (g + l2 * *p);
            *p += *velocity;
        }
    }
}

per_isa! {
    /// `acc += x`, element by element.
    pub fn sum_into<S>(_simd: S, acc: &mut [f32], x: &[f32]) {
        assert_eq!(acc.len(), x.len(), "sum_into: acc and x differ in length");
        for (acc, &x) in acc.iter_mut().zip(x) {
            *acc += x;
        }
    }
}

per_isa! {
    /// `y += share * (x - y)`, element by element.
    pub fn move_towards<S>(_simd: S, share: f32, y: &mut [f32], x: &[f32]) {
        assert_eq!(y.len(), x.len(), "move_towards: y and x differ in length");
        for (y, &x) in y.iter_mut().zip(x) {
            *y += share * (x - *y);
        }
    }
}

per_isa! {
    /// `x *= a`.
    pub fn scale<S>(_simd: S, x: &mut [f32], a: f32) {
        for x in x {
            *x *= a;
        }
    }
}

per_isa! {
    /// The sum of the squares of `x`, taken in `f64`.
    pub fn sum_of_squares<S>(_simd: S, x: &[f32]) -> f64 {
        let mut sums = [0.0f64; 16];
        let (blocks, rest) = x.as_chunks::<16>();
        for block in blocks {
            for (sum, &x) in sums.iter_mut().zip(block) {
                *sum += f64::from(x) * f64::from(x);
            }
        }
        for (sum, &x) in sums.iter_mut().zip(rest) {
            *sum += f64::from(x) * f64::from(x);
        }
        sums.iter().sum()
    }
}
