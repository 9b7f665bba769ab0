//! What the two servers, [`serve`](crate::serve) and [`live`](crate::live), share.

pub(crate) mod http;
