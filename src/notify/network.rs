//! Which addresses a request may go to that somebody else chose.
//!
//! Only addresses of the public internet, by the registries of special-purpose addresses (IANA, RFC 6890): everything else is
//! refused, also where an IPv6 address carries a refused IPv4 one inside. What the operator names is let through all the same.

use ipnet::IpNet;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};

/// IPv4 networks that are no part of the public internet: this host, private, shared by carriers, loopback, link-local, protocol
/// assignments, documentation, relays of 6to4, benchmarks, multicast, reserved with broadcast.
const REFUSED: [(Ipv4Addr, u32); 15] = [
    (Ipv4Addr::new(0, 0, 0, 0), 8),
    (Ipv4Addr::new(10, 0, 0, 0), 8),
    (Ipv4Addr::new(100, 64, 0, 0), 10),
    (Ipv4Addr::new(127, 0, 0, 0), 8),
    (Ipv4Addr::new(169, 254, 0, 0), 16),
    (Ipv4Addr::new(172, 16, 0, 0), 12),
    (Ipv4Addr::new(192, 0, 0, 0), 24),
    (Ipv4Addr::new(192, 0, 2, 0), 24),
    (Ipv4Addr::new(192, 88, 99, 0), 24),
    (Ipv4Addr::new(192, 168, 0, 0), 16),
    (Ipv4Addr::new(198, 18, 0, 0), 15),
    (Ipv4Addr::new(198, 51, 100, 0), 24),
    (Ipv4Addr::new(203, 0, 113, 0), 24),
    (Ipv4Addr::new(224, 0, 0, 0), 4),
    (Ipv4Addr::new(240, 0, 0, 0), 4),
];

/// IPv6 networks within the global unicast space that are no part of the public internet: protocol assignments with Teredo,
/// documentation, 6to4, documentation again.
const REFUSED_GLOBAL: [(Ipv6Addr, u32); 4] = [
    (Ipv6Addr::new(0x2001, 0, 0, 0, 0, 0, 0, 0), 23),
    (Ipv6Addr::new(0x2001, 0xdb8, 0, 0, 0, 0, 0, 0), 32),
    (Ipv6Addr::new(0x2002, 0, 0, 0, 0, 0, 0, 0), 16),
    (Ipv6Addr::new(0x3fff, 0, 0, 0, 0, 0, 0, 0), 20),
];
/// The global unicast space: what lies outside of it is local, multicast, or not assigned.
const GLOBAL: (Ipv6Addr, u32) = (Ipv6Addr::new(0x2000, 0, 0, 0, 0, 0, 0, 0), 3);
/// Addresses by which hosts without IPv4 reach it (RFC 6052): as good as the IPv4 address inside.
const NAT64: (Ipv6Addr, u32) = (Ipv6Addr::new(0x64, 0xff9b, 0, 0, 0, 0, 0, 0), 96);

/// Whether a request may go there; `allowed` are networks that the operator named.
pub fn is_permitted(address: IpAddr, allowed: &[IpNet]) -> bool {
    // ::ffff:127.0.0.1 connects to 127.0.0.1
    let address = address.to_canonical();
    if allowed.iter().any(|network| network.contains(&address)) {
        return true;
    }
    match address {
        IpAddr::V4(v4) => is_public_v4(v4),
        IpAddr::V6(v6) if within_v6(v6, NAT64) => {
            let [.., a, b, c, d] = v6.octets();
            is_public_v4(Ipv4Addr::new(a, b, c, d))
        }
        IpAddr::V6(v6) => within_v6(v6, GLOBAL) && !REFUSED_GLOBAL.iter().any(|&network| within_v6(v6, network)),
    }
}

fn is_public_v4(address: Ipv4Addr) -> bool {
    !REFUSED.iter().any(|&(network, bits)| (address.to_bits() ^ network.to_bits()) >> (32 - bits) == 0)
}

fn within_v6(address: Ipv6Addr, (network, bits): (Ipv6Addr, u32)) -> bool {
    (address.to_bits() ^ network.to_bits()) >> (128 - bits) == 0
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn permitted(text: &str) -> bool {
        is_permitted(text.parse().expect(text), &[])
    }

    #[test]
    fn the_public_internet_is_let_through() {
        let public = [
            "1.1.1.1",
            "93.184.216.34",
            "172.15.255.255",
            "172.32.0.0",
            "100.63.255.255",
            "100.128.0.0",
            "223.255.255.255",
        ];
        let public =
            public.into_iter().chain(["2606:4700::1111", "2a00:1450:4001::1", "::ffff:1.1.1.1", "64:ff9b::1.1.1.1"]);
        for address in public {
            assert!(permitted(address), "{address}");
        }
    }

    #[test]
    fn everything_else_is_refused() {
        let local = [
            "0.0.0.0",
            "0.1.2.3",
            "10.0.0.1",
            "100.64.0.1",
            "127.0.0.1",
            "127.255.255.254",
            "169.254.169.254",
            "172.16.0.1",
        ];
        let special =
            ["172.31.255.255", "192.0.0.8", "192.0.2.1", "192.88.99.1", "192.168.1.1", "198.18.0.1", "198.51.100.1"];
        let last = ["203.0.113.9", "224.0.0.1", "239.255.255.255", "240.0.0.1", "255.255.255.255"];
        let v6 = [
            "::",
            "::1",
            "fe80::1",
            "fc00::1",
            "fd12::1",
            "ff02::1",
            "2001::1",
            "2001:db8::1",
            "2002:7f00:1::",
            "3fff::1",
            "100::1",
        ];
        // 127.0.0.1 and the address of cloud metadata inside IPv6: mapped, compatible, NAT64 with either prefix, 6to4, ISATAP
        let inside = [
            "::ffff:127.0.0.1",
            "::127.0.0.1",
            "64:ff9b::7f00:1",
            "64:ff9b:1::7f00:1",
            "2002:a9fe:a9fe::1",
            "fe80::5efe:7f00:1",
        ];
        let mapped = ["::ffff:169.254.169.254", "::ffff:10.0.0.1", "64:ff9b::a9fe:a9fe", "64:ff9b::10.0.0.1"];
        for address in local.iter().chain(&special).chain(&last).chain(&v6).chain(&inside).chain(&mapped) {
            assert!(!permitted(address), "{address}");
        }
    }

    #[test]
    fn a_network_that_the_operator_names_is_let_through_and_its_neighbour_is_not() {
        let allowed: Vec<IpNet> = vec!["10.1.0.0/16".parse().expect("network"), "fd00::/8".parse().expect("network")];
        let is = |text: &str| is_permitted(text.parse().expect(text), &allowed);
        assert!(is("10.1.2.3") && is("::ffff:10.1.2.3") && is("fd12::1"));
        assert!(!is("10.2.0.1") && !is("127.0.0.1") && !is("fc00::1"));
    }

    proptest! {
        /// The standard library's own notions, where it has stable ones.
        #[test]
        fn what_the_standard_library_calls_local_is_never_let_through(bits in any::<u32>()) {
            let v4 = Ipv4Addr::from_bits(bits);
            let local = v4.is_private() || v4.is_loopback() || v4.is_link_local() || v4.is_multicast() || v4.is_broadcast()
                || v4.is_documentation() || v4.is_unspecified();
            for address in [IpAddr::V4(v4), IpAddr::V6(v4.to_ipv6_mapped())] {
                prop_assert!(!(local && is_permitted(address, &[])));
            }
            prop_assert!(!is_permitted(IpAddr::V6(v4.to_ipv6_compatible()), &[]));
        }

        #[test]
        fn local_ipv6_is_never_let_through(bits in any::<u128>()) {
            let v6 = Ipv6Addr::from_bits(bits);
            let local = v6.is_loopback() || v6.is_multicast() || v6.is_unspecified() || v6.is_unique_local() || v6.is_unicast_link_local();
            prop_assert!(!(local && is_permitted(IpAddr::V6(v6), &[])));
        }
    }
}
