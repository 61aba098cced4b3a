use shrinkd::field::*; use shrinkd::settings::*; use shrinkd::shrink::*; use shrinkd::field::sampler::Tally; use glam::DVec3;
struct Blob;
fn s(x:f32,y:f32,z:f32)->f32{ let mut v=(x*x+y*y+z*z).sqrt()-0.35; for (a,b,c) in [(1.,0.,0.),(-1.,0.,0.),(0.,1.,0.),(0.,0.,1.0f32),(0.,0.,-1.0)]{ let t=(x*a+y*b+z*c).clamp(0.0,0.7); let d=((x-a*t).powi(2)+(y-b*t).powi(2)+(z-c*t).powi(2)).sqrt()-0.1; let k=0.1;let h=(k-(v-d).abs()).max(0.0)/k; v=v.min(d)-h*h*k/4.0;} v}
impl Field for Blob{ fn domain(&self)->Domain{Domain::default()} fn metric(&self)->Metric{Metric::Bound} fn lipschitz(&self)->Option<f32>{Some(1.0)}
 fn values(&self,p:Points<'_>,v:&mut[f32]){for i in 0..p.len(){v[i]=s(p.x[i],p.y[i],p.z[i]);}}
 fn gradients(&self,p:Points<'_>,v:&mut[f32],g:Gradients<'_>){let e=1e-3;for i in 0..p.len(){let(x,y,z)=(p.x[i],p.y[i],p.z[i]);v[i]=s(x,y,z);g.x[i]=(s(x+e,y,z)-s(x-e,y,z))/(2.*e);g.y[i]=(s(x,y+e,z)-s(x,y-e,z))/(2.*e);g.z[i]=(s(x,y,z+e)-s(x,y,z-e))/(2.*e);}}}
fn main(){ let pool=rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap(); let cancel=CancelToken::new(); let t0=std::time::Instant::now();
 let prog=|p:Progress|{eprintln!("{:7.3} {} {:.2} E {:?} flips {:?} front {:?}",t0.elapsed().as_secs_f64(),p.stage,p.fraction,p.energy,p.flips,p.front.map(|f|f.positions.len()))};
 let st=Settings{pool:&pool,cancel:&cancel,progress:&prog}; let tally=Tally::new();
 let f=Blob; let sampler=Sampler::new(&f,st,&tally);
 for lat in [lattice::LatticeSpec::default(),lattice::LatticeSpec::Octahedral{n:72}]{
 let w=shrink(&sampler,&ShrinkSpec{method:Method::Adaptive,lattice:lat}).unwrap();
 println!("{:?} {:?}",tally.by_stage(),tally.total());
 let t=w.lattice.triangles(&w.diagonals); let mut fl=0; let c:Vec<DVec3>=t.iter().map(|t|t.iter().map(|&v|w.positions[v as usize]).sum::<DVec3>()/3.0).collect(); let (v,g)=sampler.gradients(&c).unwrap();
 for i in 0..t.len(){let [a,b,d]=t[i].map(|v|w.positions[v as usize]); if (b-a).cross(d-a).dot(g[i])<=0.0{fl+=1;}}
 println!("flips {fl} of {} max centroid |s| {:.2e}",t.len(),v.iter().fold(0.0f64,|a,b|a.max(b.abs()))); }
}
